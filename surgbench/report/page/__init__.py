"""The report as one HTML page that opens from disk: tables, plots over time, pictures, and where every row is from."""
