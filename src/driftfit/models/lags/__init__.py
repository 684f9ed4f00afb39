"""Lags in regressors: past outputs that are missing, and those that are doubted."""
