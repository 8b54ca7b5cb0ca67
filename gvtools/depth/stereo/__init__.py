"""Multi-view stereo: depth from photographs with known poses."""
