"""Versions: of fkgen, and of the C interface that it generates."""

__version__ = "0.1.0"

#: Changes when a program written against a generated header would have to change.
API_VERSION = 1
