"""Parameters of a filter from records, by maximum likelihood."""
