"""The committed table of `warpfea bench --product` on one H200 holds its bars; it may be made in several runs."""

import json
import pathlib

import pytest

RESULTS = pathlib.Path(__file__).resolve().parent / "results"
ANCF = ("beam", "plate", "ENMC", "FN18")
PRECISIONS = ("float64", "float32")


@pytest.fixture(scope="module")
def rows():
    files = sorted(RESULTS.glob("product_h200*.json"))
    assert files, "tests/results/product_h200.json is missing: warpfea bench --product --out product_h200.json"
    contents = [json.loads(path.read_text()) for path in files]
    for content in contents:
        assert content["command"].startswith("warpfea bench --product")
        assert len(content["commit"]) >= 40
        assert content["machine"]["gpu"].endswith("H200")
        assert content["versions"]["warp"]
    assert len({content["commit"] for content in contents}) == 1
    return [row for content in contents for row in content["rows"]]


@pytest.mark.parametrize(("dtype", "bar"), [("float64", 8e9), ("float32", 20e9)])
def test_four_million_unknowns_of_t10_from_the_elements(rows, dtype, bar):
    row = max((r for r in rows if (r["problem"], r["dtype"]) == ("bar", dtype)), key=lambda r: r["unknowns"])
    assert row["unknowns"] >= 3.9e6
    assert row["operator"] == "elements"
    assert row["chosen"]
    assert row["unknowns_per_s"] == pytest.approx(1e3 * row["unknowns"] / row["ms"])
    assert row["unknowns_per_s"] >= bar


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("problem", ANCF)
def test_ancf_elements_tell_their_limit(rows, problem, dtype):
    found = [r for r in rows if (r["problem"], r["dtype"]) == (problem, dtype)]
    assert {r["operator"] for r in found} == {"elements", "matrix"}
    assert sum(r["chosen"] for r in found) == len(found) / 2
    for row in found:
        assert row["unknowns"] >= 9e5
        assert row["unknowns_per_s"] > 0.0


def test_shares_are_of_the_limit_that_binds(rows):
    for row in rows:
        shares = {"bandwidth": row["bandwidth_share"], "arithmetic": row["arithmetic_share"]}
        assert row["peak_Gflops"] == {"float64": 34e3, "float32": 67e3}[row["dtype"]]
        assert row["arithmetic_share"] == pytest.approx(row["Gflops"] / row["peak_Gflops"])
        assert row["bandwidth_share"] == pytest.approx(row["GBps"] / row["copy_GBps"])
        assert row["limit_share"] == shares[row["limit"]] == max(shares.values())
        assert 0.0 < row["limit_share"] < 1.25  # reads are a little faster than a copy
        assert row["memory_per_unknown"] > row["bytes_per_unknown"]
