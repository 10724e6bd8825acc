"""Evaluation, benchmark and check programs. Nothing imports them."""
