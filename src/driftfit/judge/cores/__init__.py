"""Judge many runs at once, in threads or in processes."""
