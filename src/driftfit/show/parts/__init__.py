"""The common style of the tables and pictures of all results; it uses runs only, and no function that analyses them."""
