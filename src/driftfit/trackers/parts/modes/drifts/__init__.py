"""Kinds of drift of the filters, besides the common and the single ladder."""
