"""Registration of predicted contours with observed masks, and the belief that it updates."""
