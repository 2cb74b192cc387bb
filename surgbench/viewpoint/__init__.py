"""The viewpoint task: a camera-holding arm that keeps a moving feature in view (AutoCam, arXiv 2505.10398)."""
