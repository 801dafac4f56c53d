"""What kernels share: number types, structs, sums over threads, inverses of 3x3 blocks."""
