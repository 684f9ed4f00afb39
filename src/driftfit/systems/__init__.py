"""Simulated systems whose parameters are known at every sample, and the laws by which parameters drift."""
