"""Arms that hold instruments: their kinematics as data."""
