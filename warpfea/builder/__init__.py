"""Scene description with immediate validation."""
