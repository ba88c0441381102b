"""Best linear estimators of a chain of plants: Kalman, Lemma 2, jumps."""
