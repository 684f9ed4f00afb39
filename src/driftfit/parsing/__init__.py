"""Models and trackers from text, for the command line and the configuration of a service."""
