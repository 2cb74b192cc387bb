"""State filters: where the next frame's search begins."""
