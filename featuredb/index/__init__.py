"""What a query searches: maps of one area in one frame, and a FAISS index over their descriptors."""
