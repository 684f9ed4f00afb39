"""The page and the HTTP interface, in a process of their own."""
