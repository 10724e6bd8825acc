"""Where new photos and reconstructions lie: localised photos, correspondences, placement, refinement."""
