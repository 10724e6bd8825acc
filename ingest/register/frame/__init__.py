"""One photo registered to a scan: star of renders, features or dense pieces, fit, verdict."""
