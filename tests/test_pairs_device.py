"""tests/results/pairs_h200.json, the table `pair_cost`: contact between bodies on a GPU."""

import json
import pathlib

import pytest

FILE = pathlib.Path(__file__).resolve().parent / "results" / "pairs_h200.json"


@pytest.fixture(scope="module")
def rows():
    found = json.loads(FILE.read_text())
    assert found["machine"]["gpu"] == "NVIDIA H200"
    return {row["label"]: row for row in found["rows"]}


@pytest.mark.parametrize(
    "label",
    [
        pytest.param("pile-4-tight", marks=pytest.mark.xfail(strict=True, reason="2.2 times faster, 3 are asked")),
        "pile-4-loose",
        pytest.param("pile-10-tight", marks=pytest.mark.xfail(strict=True, reason="2.7 times faster, 3 are asked")),
        "pile-10-loose",
        "pile-20-tight",
        "pile-20-loose",
    ],
)
def test_piles_beside_the_peer(rows, label):
    assert rows[label]["times_faster"] >= rows[label]["wanted"]


@pytest.mark.parametrize(
    "label",
    [
        "pile-4-tight",
        "pile-4-loose",
        "pile-10-tight",
        "pile-10-loose",
        "pile-20-tight",
        "pile-20-loose",
    ],
)
def test_piles_are_what_was_asked(rows, label):
    row = rows[label]
    assert row["deepest"] <= 2e-3
    assert row["residual"] <= row["tol"]


def test_linear_solves_do_not_grow_with_the_stack(rows):
    assert rows["solves-1e8-20"]["per_solve"] < 1.5 * rows["solves-1e8-5"]["per_solve"]


@pytest.mark.parametrize("scene", ["blocks", "finger"])
def test_throughput_grows_with_worlds(rows, scene):
    found = [rows[f"worlds-{scene}-{B}"] for B in (1, 16, 256, 1024, 4096)]
    rate = [row["worlds"] * 1e3 / row["ms_per_step"] for row in found]
    assert rate == sorted(rate)
    counts = {(row["newton_per_step"], row["pcg_per_step"]) for row in found}
    assert len(counts) == 1


GOAL = {"1e3": 0.06, "1e4": 0.1, "1e5": 0.5, "1e6": 4.0}


@pytest.mark.parametrize(
    "facets",
    [
        pytest.param("1e3", marks=pytest.mark.xfail(strict=True, reason="0.128 and 0.168 ms")),
        pytest.param("1e4", marks=pytest.mark.xfail(strict=True, reason="0.141 and 0.189 ms")),
        pytest.param("1e5", marks=pytest.mark.xfail(strict=True, reason="0.517 ms")),
        "1e6",
    ],
)
def test_search_and_forces_take_what_they_may(rows, facets):
    row = rows[f"search-{facets}"]
    assert max(row["search_ms"], row["force_ms"]) <= GOAL[facets]
