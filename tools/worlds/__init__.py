"""Worlds of the simulated town for tools and tests: photos of communities, walks, poisoned gifts, films."""
