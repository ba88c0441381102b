"""What the oracles say about a spec and a record: the closed forms of the families."""
