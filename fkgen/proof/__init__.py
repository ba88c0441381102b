"""Confront a recursion with its closed forms, and the C with the recursion."""
