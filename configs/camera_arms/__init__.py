"""Arms that hold the camera of the viewpoint task, as data."""
