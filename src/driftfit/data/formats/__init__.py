"""Text files: cells of CSV files, and the signs with which their numbers are written."""
