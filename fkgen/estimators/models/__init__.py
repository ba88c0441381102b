"""Multiple models: banks, mode probabilities, ways to merge."""
