"""The scoreboard: what README and docs claim, run, kept by commit, written into the documentation."""
