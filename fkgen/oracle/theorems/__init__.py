"""The algebra behind the filters, proved by SymPy for small dimensions."""
