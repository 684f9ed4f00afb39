"""Model structure: orders, delays and regressors, selected or averaged."""
