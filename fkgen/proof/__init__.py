"""Confront a recursion with its closed forms; only what survives reaches the back end."""
