"""``oodd-eval leaderboard submit`` and ``verify``."""
