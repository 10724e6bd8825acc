"""The scoreboard, the programs that its rows run, and checks. Nothing imports them."""
