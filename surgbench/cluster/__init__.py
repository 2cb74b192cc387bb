"""Runs and generations on a Dask cluster whose machines see the same files."""
