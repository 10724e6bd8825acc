"""Photos to geo-registered feature maps: scan, match, structure from motion, placement, report."""
