"""The frozen video prior: Wan2.2-VACE's features, and its offline converter."""
