"""What derives from records: leaderboard rows, tables, and pictures of the estimates."""
