"""Splits on their way: copies fetched from elsewhere, and exports to other projects' formats."""
