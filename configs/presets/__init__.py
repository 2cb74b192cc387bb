"""Presets: whole configurations of generated datasets."""
