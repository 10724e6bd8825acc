"""Keypoints and RootSIFT descriptors: the one extractor that ingest and queries share."""
