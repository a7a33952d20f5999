"""The energy balance of an orbit: what is conserved along it, and the gravity field that can be read from it."""
