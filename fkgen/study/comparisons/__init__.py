"""Several filters for one plant and its faults: scores, costs, a recommendation."""
