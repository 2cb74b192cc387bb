"""Built-in instrument files."""
