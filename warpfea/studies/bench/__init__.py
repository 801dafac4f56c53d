"""Benchmarks of the solver: `warpfea bench` and its kinds of measurement, one file each."""
