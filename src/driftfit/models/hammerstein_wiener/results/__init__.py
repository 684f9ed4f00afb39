"""What a Hammerstein-Wiener run is asked for: blocks, free runs, diagnostics, pictures."""
