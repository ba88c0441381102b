"""Independent reference mathematics that shares no code with what it judges, and no CasADi."""
