"""Physics on an NVIDIA GPU: MuJoCo Warp, with the package's own kernels where they are faster."""
