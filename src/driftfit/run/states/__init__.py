"""States as bytes, and many of them continued side by side."""
