"""Answers from definitions: joint distributions and exact enumeration, no recursion."""
