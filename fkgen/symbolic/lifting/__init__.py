"""What a spec says, as CasADi expressions."""
