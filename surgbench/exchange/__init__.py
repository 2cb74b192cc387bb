"""Importers and exporters, one file each: other people's formats."""
