"""What the camera controllers after AutoCam (arXiv 2505.10398) are made of, and the simpler ones beside them."""
