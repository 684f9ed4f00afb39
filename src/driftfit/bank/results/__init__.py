"""Results of a bank besides parameters: probabilities, events and their dates, the decided path."""
