"""The first command of the README, and its data."""
