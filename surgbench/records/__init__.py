"""Records of runs: their format, and how they are read."""
