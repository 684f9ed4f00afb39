"""Commands about compiled routines."""
