"""Compiled code with a check at every index; see `lab.bounds.commands`."""
