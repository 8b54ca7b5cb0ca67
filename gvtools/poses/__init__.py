"""Poses of views: odometry, pose graph, bundle adjustment and refinement."""
