"""A leaderboard that others can join: runs handed in as one file, and what is handed in, verified."""
