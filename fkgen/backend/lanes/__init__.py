"""The program a second time, for several records at once: one in each lane of a vector."""
