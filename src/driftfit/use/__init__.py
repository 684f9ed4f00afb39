"""Uses of a run: simulation, forecasts, first passages, and the system behind it."""
