"""The compiled routine of a bank: one sample forecasts, grows, weighs and reduces the tree."""
