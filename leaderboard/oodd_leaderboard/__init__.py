"""The leaderboard: entries as data, the published board, its page, tables and site."""
