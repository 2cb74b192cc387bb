"""Bodies of instruments fitted to masks of a recording, together with the poses."""
