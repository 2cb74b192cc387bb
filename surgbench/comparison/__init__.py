"""Measurements of the engine beside what a user would reach for instead, in one run on one workload."""
