"""Detection of the tips by a network: the square that it looks at, the network, its peaks, checkpoints and training."""
