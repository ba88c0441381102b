"""Compile generated C, cache it, and run it from Python through ctypes."""
