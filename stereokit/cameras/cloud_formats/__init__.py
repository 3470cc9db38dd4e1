"""Point cloud files, a module per format.

Each writer takes points (N, 3) float32, colours (N, 3) uint8, confidence (N,) float32 or None, and a comment.
"""
