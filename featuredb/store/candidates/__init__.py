"""Contributed photos in the store: the tables `candidates` and `candidate_images`."""
