"""A U-Net that tells instruments from what is behind them."""
