"""Static curves of Hammerstein-Wiener blocks: bases and their compiled functions."""
