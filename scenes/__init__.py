"""Ready scenes: the module <name> defines the scene <name>. Each is imported when it is asked for."""
