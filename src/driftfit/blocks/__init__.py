"""The blocks of a Hammerstein-Wiener model: separation, gauges, free runs, diagnostics, pictures."""
