"""Common code of detectors that look at a window of observations: streaming and saving."""
