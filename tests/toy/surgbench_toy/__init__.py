"""A third task, as a stranger would bring it: say the next number of a series."""
