"""The step loop, its results, checkpoints and statics."""
