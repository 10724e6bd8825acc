"""One photo to a pose: features, candidates, matches, pose and lens, acceptance, the answer on Earth."""
