"""Smoothers: what a complete record says about theta at every sample, past and future together."""
