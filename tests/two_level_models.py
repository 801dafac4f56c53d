"""The bar that the two-level preconditioner is tried on."""

from warpfea.studies.bench.problems import PROBLEMS


def bar(n, **law):
    problem = PROBLEMS["bar"]
    return problem.build(problem.size_for(n), **law)
