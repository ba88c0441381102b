"""What decides how large the generated C becomes."""
