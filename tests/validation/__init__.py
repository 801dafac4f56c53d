"""Validation tables, the contents of tests/results: one module each, run by `python -m tests.validation`.

A module with a line `TABLE = Table(...)` is a table of that name; there is no other list.
"""
