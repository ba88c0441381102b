"""One page about a filter, for people to read: ``fkgen report``."""
