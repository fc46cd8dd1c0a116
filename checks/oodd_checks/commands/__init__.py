"""Commands for authors of detectors: `new` and `check`."""
