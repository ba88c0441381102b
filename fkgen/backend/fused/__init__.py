"""`code.fma`: products that are rounded together with the sum they go into."""
