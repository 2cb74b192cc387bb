"""Data files: instruments, presets, suites."""
