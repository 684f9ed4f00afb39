"""Samples without an output: what a bank does with events whose times nothing tells apart."""
