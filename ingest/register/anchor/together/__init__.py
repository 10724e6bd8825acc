"""All photos of a placed map registered to a scan at once: one similarity, one count of the evidence."""
