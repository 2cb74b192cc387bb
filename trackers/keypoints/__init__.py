"""Keypoint sources: where the tips of the instruments are in an image."""
