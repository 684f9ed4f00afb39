"""The ways to run a model with a tracker: records, fleets and streams."""
