"""Existing scans: read from PLY, LAS/LAZ, E57 and PCD, placed in the photographs' frame, fused.

Every reader checks what a header claims against the size of its file before it allocates, and
reads in chunks, so that a damaged or hostile file ends in one line and not in exhausted memory.
"""
