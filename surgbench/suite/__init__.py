"""Planning, running and recording: every run of a tracker becomes one immutable record."""
