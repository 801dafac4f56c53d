"""The tables of `python -m tests.validation joints`: cost with m joints on both devices, stability of extreme cases."""

import pytest
from result_files import content_of


@pytest.fixture(params=[("joints_cpu.json", "cpu"), ("joints_h200.json", "cuda")])
def result(request):
    name, device = request.param
    return content_of(name, device=device)


def test_cost_of_joints_is_told(result):
    rows = result["cost"]
    methods = ("default", "block Jacobi", "outer, deflated", "before: outer, block Jacobi")
    for m in (10, 100, 1000):
        single = [r for r in rows if "worlds" not in r and r["joints"] == m and r["E"] == 7e8]
        own = {r["method"]: r for r in single if r["dtype"] == "float64"}
        assert set(own) == set(methods)
        for row in own.values():
            assert row["outcome"] == "converged"
            assert row["violation"] <= 1e-8
            assert row["ms_per_step"] > 0.0
            assert row["tip_difference"] < 1e-7 * 0.5 * m
        assert own["default"]["pcg"] < 0.9 * own["before: outer, block Jacobi"]["pcg"]
        assert own["default"]["newton"] <= own["before: outer, block Jacobi"]["newton"]
        single = [r for r in single if r["dtype"] == "float32"]
        assert single[0]["outcome"] == "converged"
        assert single[0]["violation"] <= 1e-5


def test_stiff_links_gain_most(result):
    """Before and after at E = 7e10 and 7e12 Pa."""
    for E in (7e10, 7e12):
        own = {r["method"]: r for r in result["cost"] if r["E"] == E}
        assert own["default"]["outcome"] == "converged"
        before = own["before: outer, block Jacobi"]
        assert before["outcome"] != "converged" or own["default"]["pcg"] < 0.5 * before["pcg"]


def test_extreme_cases_converge_or_end_with_a_named_error(result):
    rows = result["stability"]
    pairs = {(r["E"], r["ratio"], r["dt"]) for r in rows if r["problem"] == "two links"}
    assert len(pairs) == 5 * 3 * 4
    assert {E for E, _, _ in pairs} == {1e4, 1e6, 1e8, 1e10, 1e12}
    assert max(r for _, r, _ in pairs) == 1e4
    assert {h for _, _, h in pairs} == {1e-5, 1e-4, 1e-3, 1e-2}
    problems = {r["problem"] for r in rows}
    assert problems == {"two links", "ten links", "door on four hinges", "parallelogram through its dead points"}
    for row in rows:
        if row["outcome"] == "converged":
            assert row["steps"] >= 40
            assert row["violation"] <= 1e-8
            assert abs(row["ledger_residual"]) < 1e-6
        else:
            assert row["outcome"].startswith(("ConvergenceError", "ConstraintError"))
    assert sum(r["outcome"] == "converged" for r in rows) >= 0.95 * len(rows)
