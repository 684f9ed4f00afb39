"""Bridges to other packages' habits, one module each; nothing of theirs is imported before its module is."""
