"""Films become maps: keyframes chosen, written as photos, ingested like them."""
