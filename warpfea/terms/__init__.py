"""Contributions to the residual of a step."""
