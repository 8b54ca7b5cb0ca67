"""Z-buffer point splatting: the options, and back ends on the CPU, in torch and in Open3D."""
