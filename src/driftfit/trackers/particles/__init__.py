"""What the particle filter consists of."""
