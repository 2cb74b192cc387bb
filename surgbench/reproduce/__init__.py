"""Published tables made again: what they consist of, the work behind them, how they are written, how they are checked."""
