"""Placing a map by ground control points: marks, robust similarity, adjustment, tests, report."""
