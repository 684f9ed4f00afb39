"""What the tables and pictures of all results share; it uses runs only, and no function that analyses them."""
