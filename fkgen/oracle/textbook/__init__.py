"""Filters as the literature prints them, in whole matrices."""
