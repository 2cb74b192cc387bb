"""Exporters, one file each: datasets and estimates in other people's formats."""
