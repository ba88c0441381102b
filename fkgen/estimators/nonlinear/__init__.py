"""Filters of plants by equations that do more than linearise once."""
