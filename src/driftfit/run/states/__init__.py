"""States as bytes, and many of them continued in parallel."""
