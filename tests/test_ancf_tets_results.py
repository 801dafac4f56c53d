"""tests/results/ancf_tets.json: error against unknowns and run time of T4, T10, FN, FN18, ENMC and H3843."""

import numpy as np
import pytest
from result_files import RESULTS, content_of

ELEMENTS = ("T4", "T10", "FN", "FN18", "ENMC", "H3843")
PROBLEMS = ("rigid", "large", "sudden")
CONVERGING = ("T10", "FN18", "ENMC", "H3843")


def check_errors(result, least):
    """Errors fall with refinement, and the elements rank as their polynomials say."""

    def of(problem, element):
        return [r for r in result["rows"] if r["problem"] == problem and r["element"] == element]

    for problem in ("large", "sudden"):
        for element in CONVERGING:
            errors = [r["error"] for r in of(problem, element)]
            assert np.all(np.diff(errors) < 0.0), (problem, element, errors)
    for element in ELEMENTS:
        for row in of("rigid", element):
            assert row["error"] < 1e-4, row
            assert row["error_exact"] < 5e-3, row
    for element in ("T4", "T10", "FN", "FN18", "H3843"):
        assert len(of("large", element)) >= least, element
    # with about a thousand unknowns in `large`: a quadratic or cubic element is far ahead of a linear field
    best = {e: min(r["error"] for r in of("large", e) if r["unknowns"] < 2000) for e in ELEMENTS}
    assert max(best[e] for e in CONVERGING) < 0.01 * min(best["T4"], best["FN"])


def fitted_order(result, problem, element, least):
    rows = [r for r in result["rows"] if r["problem"] == problem and r["element"] == element]
    assert len(rows) >= least
    return np.polyfit(np.log([r["cells"][1] for r in rows]), -np.log([r["error"] for r in rows]), 1)[0]


@pytest.fixture(scope="module")
def result():
    return content_of("ancf_tets.json", "warpfea study ancf-tets")


def test_result_is_of_a_whole_run(result):
    assert result["settings"]["quick"] is False
    assert (RESULTS / "ancf_tets.png").stat().st_size > 10_000
    assert len((RESULTS / "ancf_tets.csv").read_text().splitlines()) == len(result["rows"]) + 1


def test_result_holds_all_elements_on_all_problems(result):
    found = {(r["problem"], r["element"]) for r in result["rows"]}
    assert found == {(p, e) for p in PROBLEMS for e in ELEMENTS}
    unknowns = [r["unknowns"] for r in result["rows"]]
    assert min(unknowns) < 100
    assert max(unknowns) > 10000


def test_result_is_accurate(result):
    check_errors(result, least=4)
    assert result["references"]["large"]["own_error"] < 1e-5
    assert result["references"]["sudden"]["own_error"] < 1e-5
    assert result["references"]["rigid"]["time_order"] == pytest.approx(2.0, abs=0.1)


def test_result_has_the_orders_of_the_elements(result):
    order = {e: fitted_order(result, "large", e, 3) for e in ELEMENTS}
    for element in CONVERGING:
        assert order[element] > 3.0, order
        assert order[element] > order["T4"] + 1.0, order
    assert order["ENMC"] > order["T10"], order
    # as printed, FN holds linear fields alone: it does no better than T4 with a quarter of its slots per node
    assert order["FN"] < 2.0, order
