"""What tests/README.md tells of growth, of the operator and of one core stands in the committed results."""

import json
import pathlib

import pytest
from validation.cpu import CASES

RESULTS = pathlib.Path(__file__).resolve().parent / "results"


def load(name):
    path = RESULTS / name
    assert path.exists(), f"{path} is missing: see tests/README.md for the command"
    content = json.loads(path.read_text())
    assert content["command"].startswith("warpfea bench --")
    assert len(content["commit"]) >= 40
    return content["rows"]


@pytest.mark.parametrize(("problem", "below", "worst"), [("bar", 15, 2.6), ("plate", 13, 2.5), ("beam", 18, 1.25)])
def test_iterations_grow_where_the_readme_says(problem, below, worst):
    rows = [r for r in load("growth_h200.json") + load("growth_h200_beam.json") if r["problem"] == problem]
    assert len(rows) == 18
    assert all(outcome == "converged" for r in rows for outcome in r["outcome"])
    assert max(r["unknowns"][-1] for r in rows) > 999_990
    assert sum(r["growth"] < 1.5 for r in rows) == below
    assert max(r["growth"] for r in rows) < worst
    stiff = [r for r in rows if r["E"] == 1e11 and r["dt"] >= 1e-3]
    assert max(r["growth"] for r in stiff) < 1.3  # of statics it is flat


def test_the_operator_at_four_million_unknowns():
    rows = {r["dtype"]: r for r in load("product_h200.json")}
    assert rows["float64"]["unknowns"] > 3.9e6
    assert rows["float64"]["unknowns_per_s"] > 11e9  # the bar is 8e9
    assert rows["float32"]["unknowns_per_s"] > 20e9


@pytest.mark.parametrize("problem", ["beam", "plate", "ENMC", "FN18"])
def test_the_matrix_of_ancf_elements_uses_half_of_the_bandwidth(problem):
    rows = load("product_h200_ancf.json") + load("product_h200_tets.json")
    chosen = [r for r in rows if r["problem"] == problem and r["chosen"]]
    assert {r["operator"] for r in chosen} == {"matrix"}
    assert {r["dtype"] for r in chosen} == {"float64", "float32"}
    for row in chosen:
        assert row["limit"] == "bandwidth"
        assert row["limit_share"] > (0.6 if row["dtype"] == "float64" else 0.4)


def on_one_core():
    """ms per step by row and solver."""
    rows = {}
    for row in load("cpu.json"):
        rows.setdefault(row["label"], {})[row["solver"]] = row["ms_per_step"]
    assert len(rows) == 12
    return rows


@pytest.mark.parametrize("label", [case.label for case in CASES])
def test_one_core_against_superlu(label):
    ms = on_one_core()[label]
    assert ms["direct"] is None or ms["default"] < ms["direct"]


def test_one_core_against_block_jacobi_and_chrono():
    rows = on_one_core()
    for label, ms in rows.items():
        assert ms["default"] < ms["block-jacobi"], label
    chrono = {case.label: case.chrono[0] for case in CASES if case.chrono}
    assert len(chrono) == 7
    for label, ms in chrono.items():
        assert rows[label]["default"] < ms, label
