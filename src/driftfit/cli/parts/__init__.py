"""What several commands share: what is typed, what is read, how errors are said."""
