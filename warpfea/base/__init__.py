"""Shared utilities: errors, kernel launches, atomic file writing, console text."""
