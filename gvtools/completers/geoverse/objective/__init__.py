"""The training objective: its five terms, and the camera-centre scale."""
