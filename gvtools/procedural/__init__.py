"""Rooms drawn from a seed and rendered with exact depth, for training and for the demo."""
