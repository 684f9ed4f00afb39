"""Laws by which single parameters move, and the Kalman filter that follows them."""
