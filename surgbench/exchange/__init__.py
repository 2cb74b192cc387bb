"""Importers, one file each: other people's formats."""
