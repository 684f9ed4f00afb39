"""The frozen model of a reference, and the "glr" and "cusum" statistics on it."""
