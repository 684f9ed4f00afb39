"""Sources and sinks of the service: what they are in `base`, the samples in `samples`, and a file for each system."""
