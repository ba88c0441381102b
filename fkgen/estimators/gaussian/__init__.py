"""One Gaussian: update with the rows present, propagation, rank decisions."""
