"""The configuration: options of a TOML file, and the topics of units."""
