"""Recordings that apps for phones export, read with their own poses and LiDAR depth."""
