"""The committed table of `warpfea bench --growth` on one H200 holds its bar."""

import itertools
import json
import pathlib

import numpy as np
import pytest

RESULTS = pathlib.Path(__file__).resolve().parent / "results"


@pytest.fixture(scope="module")
def growth():
    content = json.loads((RESULTS / "growth_h200.json").read_text())
    assert content["command"].startswith("warpfea bench --growth")
    assert len(content["commit"]) >= 40
    assert content["machine"]["gpu"].endswith("H200")
    assert content["versions"]["warp"]
    return content


def test_growth_covers_the_product_from_10k_to_1m(growth):
    rows = growth["rows"]
    product = set(itertools.product(("bar", "beam", "plate"), (1e5, 1e8, 1e11), (1e-4, 1e-3, 1e-2), (0.3, 0.49)))
    assert {(r["problem"], r["E"], r["dt"], r["nu"]) for r in rows} == product
    assert len(rows) == len(product)
    for row in rows:
        assert np.log10(row["unknowns"]) == pytest.approx([4, 5, 6], abs=0.05)


@pytest.mark.parametrize("problem", ["bar", "beam", "plate"])
def test_iterations_grow_by_less_than_half(growth, problem):
    rows = [r for r in growth["rows"] if r["problem"] == problem]
    bad = [
        f"E {r['E']:g}, dt {r['dt']:g}, nu {r['nu']:g}: PCG {r['pcg']}"
        for r in rows
        if r["growth"] is None or not r["growth"] < 1.5
    ]
    assert rows
    assert not bad, "\n".join(bad)
