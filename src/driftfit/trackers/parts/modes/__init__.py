"""Several filters side by side, each with a drift or a noise of its own, for trackers that find both as they go."""
