"""From a table to an answer: roles of columns, structure, what changes and why; one page."""
