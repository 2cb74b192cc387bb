"""SAM 2 on video: checkpoints found, checked and converted, and objects followed from frame to frame."""
