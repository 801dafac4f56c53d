"""Scenes of studies of error against run time: `warpfea study tests/validation/problems/NAME.py`, from the root."""
