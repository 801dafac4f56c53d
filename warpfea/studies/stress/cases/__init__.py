"""The cases of the stress suite, by theme."""
