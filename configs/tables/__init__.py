"""Tables that `surgbench reproduce` makes."""
