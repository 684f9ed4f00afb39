"""Results of a Hammerstein-Wiener run: blocks, free runs, diagnostics, plots."""
