"""Published tables made again: what they consist of, the work behind them, their files, and how they are checked."""
