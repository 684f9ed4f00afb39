"""What a bank is asked for beside parameters: probabilities, events and their dates, the decided path."""
