"""Fault codes: samples that contradict all others."""
