"""Initialisers: where a sequence's first search begins."""
