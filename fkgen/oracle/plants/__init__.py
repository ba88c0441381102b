"""Plants with faults as NumPy sees them: systems, laws of faults, simulation."""
