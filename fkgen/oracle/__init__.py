"""Independent reference mathematics: closed forms that share no code with what they judge.

Joint distributions of whole records, exact enumeration, Riccati equations and symbolic identities
in NumPy, SciPy, SymPy and python-control; CasADi never appears.
"""
