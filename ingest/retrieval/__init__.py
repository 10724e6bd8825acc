"""Which photos look alike: one vector for each, in files of the work folder, and neighbours among them."""
