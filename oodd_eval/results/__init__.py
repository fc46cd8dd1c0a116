"""Results: records and score files of evaluated cells, their metrics, tables and comparisons."""
