"""The constant side of a scene: bodies, their surfaces, tables and topology."""
