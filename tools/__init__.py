"""The scoreboard, the programs that its rows run, and checks. None of the packages imports them; tests do."""
