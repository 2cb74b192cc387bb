"""Datasets on disk, whatever their task: manifest, integrity, tables and pictures, opening and checking."""
