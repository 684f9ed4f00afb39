"""The leaves of the hypothesis tree: one Kalman filter for each history."""
