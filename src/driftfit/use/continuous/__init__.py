"""Between discrete and continuous time."""
