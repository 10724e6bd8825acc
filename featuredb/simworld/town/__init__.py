"""The simulated town: what stands where, and of what material it is."""
