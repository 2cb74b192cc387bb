"""Recordings as laboratories have them: what their files are called, and what their masks mean."""
