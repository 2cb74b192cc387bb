"""Optimisers that trackers and initialisers share: ask, evaluate, tell."""
