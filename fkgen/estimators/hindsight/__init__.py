"""Estimates of past samples: what a smoother needs of a filter, and of what it has seen."""
