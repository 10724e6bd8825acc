"""Photos that overlap, cut into blocks of bounded size, reconstructed one by one and joined again."""
