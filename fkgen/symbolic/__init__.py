"""The language that families are written in: ports, phases, and linear algebra without inverses."""
