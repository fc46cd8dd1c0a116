"""Commands that read logs: `data inspect`, `data import`, `data export`, `scan`."""
