"""Leaderboard: entries as data, their verification, and the pages made from them."""
