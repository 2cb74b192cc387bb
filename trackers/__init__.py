"""Trackers, one file each; initialisers, filters, keypoint sources and optimisers in sub-folders."""
