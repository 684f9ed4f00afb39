"""The compiled steps of transfer functions in coloured noise."""
