"""Pictures of runs: plots, report, web viewer, Open3D window."""
