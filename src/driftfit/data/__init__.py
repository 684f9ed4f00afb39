"""Data as users have them: arrays, tables and files, times, limits and labels; and results as tables and files."""
