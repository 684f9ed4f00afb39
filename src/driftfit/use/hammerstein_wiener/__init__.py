"""What is computed from runs of Hammerstein-Wiener models: blocks, diagnostics, free runs, fits of constant systems."""
