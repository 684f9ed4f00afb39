"""What sensors do to data: the gate between a tracker's forecast and its correction, and the screen of ungated runs."""
