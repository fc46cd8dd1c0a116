"""Entries of the leaderboard: their format, how one is written, and how it is checked as data."""
