"""Drawing trials of a plant and its faults, in C."""
