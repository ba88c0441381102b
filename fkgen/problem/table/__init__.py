"""Tables of a spec: places, keys, refusals."""
