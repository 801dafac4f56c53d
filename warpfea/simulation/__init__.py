"""Step loop, results, checkpoints and statics."""
