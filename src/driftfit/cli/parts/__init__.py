"""Parts that several commands share: parsing arguments, reading data, reporting errors."""
