"""Scenes of warpfea: the module <name> defines the scene <name>, imported on demand."""
