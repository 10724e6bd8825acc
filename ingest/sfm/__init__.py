"""Structure from motion by stages: features, pairs, matches, models, and what joins them."""
