"""Where trackers' masks come from: the dataset, or its images."""
