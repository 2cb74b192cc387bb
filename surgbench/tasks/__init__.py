"""The tasks: each folder is one, found by its name."""
