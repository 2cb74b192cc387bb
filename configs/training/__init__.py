"""Suites: which trackers run with which settings."""
