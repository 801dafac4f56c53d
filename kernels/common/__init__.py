"""Shared device code: number types, structs, sums over threads, inverses of 3x3 blocks."""
