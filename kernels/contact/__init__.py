"""Contact by stages: boxes, facet search, projection, laws, forces of points, assembly, ledger."""
