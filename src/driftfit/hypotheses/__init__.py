"""What may have happened at a sample: how parameters moved, how the sensor failed; and how a bank is kept small."""
