"""Reading data: arrays, tables and files, times, limits and labels; and writing results as tables and files."""
