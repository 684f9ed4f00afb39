"""Smoothers: estimates of theta at every sample from the complete record, past and future."""
