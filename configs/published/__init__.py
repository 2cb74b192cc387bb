"""Published figures: what a reproduced table is held against."""
