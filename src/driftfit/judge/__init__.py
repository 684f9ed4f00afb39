"""Judging a run: verdict, diagnosis, segments, comparison with what a user would otherwise do."""
