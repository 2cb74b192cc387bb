"""surgbench: make surgical instrument tracking data, run trackers on it, and compare them."""

__version__ = "0.1.0"
