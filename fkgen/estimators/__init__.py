"""The estimators: from modes and measurements to the blocks of a recursion."""
