"""What kernels share: types, structs, lanes, sums."""
