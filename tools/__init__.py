"""The scoreboard, the programs that its rows run, and checks. None of the packages imports them; tests do.

A program's arguments are in its --help; docs/measurements.md has the commands of all rows.
"""
