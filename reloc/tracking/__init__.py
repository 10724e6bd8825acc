"""Poses of the frames of a video: optical flow between frames, the feature map against drift."""
