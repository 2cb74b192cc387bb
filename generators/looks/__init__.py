"""Images of the instruments: what they are made of, what lies behind them, the light, and the camera."""
