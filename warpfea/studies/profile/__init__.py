"""Run time of a step by part and kernel."""
