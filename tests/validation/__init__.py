"""Tables of validation: what the files of tests/results hold, each a module here, run by `python -m tests.validation`.

A module with a line `TABLE = Table(...)` is a table of that name; there is no other list.
"""
