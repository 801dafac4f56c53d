"""Committed results hold their bars; made by the commands that stand in them."""

import json
import pathlib

import numpy as np
import pytest

RESULTS = pathlib.Path(__file__).resolve().parent / "results"


def load(name):
    result = json.loads((RESULTS / name).read_text())
    assert result["command"]
    assert result["commit"]
    assert result["machine"]
    assert result["versions"]["warp"]
    return result


def test_bench_on_one_gpu():
    result = load("bench_h200.json")
    assert "H200" in result["machine"]["gpu"]
    for dtype, residual, error in (("float64", 1e-8, 1e-8), ("float32", 5e-4, 1e-4)):
        rows = [r for r in result["rows"] if r["dtype"] == dtype]
        assert np.log10([r["unknowns"] for r in rows]) == pytest.approx([3, 4, 5, 6], abs=0.1)
        for row in rows:
            assert row["ms_per_step"] > 0.0
            assert row["bytes_per_unknown"] < 1000.0
            assert row["residual"] < residual
            assert row["tip_error"] < error


@pytest.mark.parametrize("name", ["bench_cpu.json", "bench_ancf_cpu.json"])
def test_bench_on_the_cpu(name):
    result = load(name)
    assert result["settings"]["steps"] >= 10
    assert {r["dtype"] for r in result["rows"]} == {"float64", "float32"}
    assert all(r["tip_error"] < 1e-4 for r in result["rows"])


def test_bench_of_beams_and_plates_on_one_gpu():
    result = load("bench_ancf_h200.json")
    assert "H200" in result["machine"]["gpu"]
    elements = {"beam": [30, 300, 1000, 3000, 10000], "plate": [32, 128, 512, 2048, 8192]}
    for problem, counts in elements.items():
        for dtype, residual, error in (("float64", 1e-8, 1e-8), ("float32", 1e-3, 1e-4)):
            rows = [r for r in result["rows"] if r["problem"] == problem and r["dtype"] == dtype]
            assert [r["elements"] for r in rows] == counts
            assert all(r["ms_per_step"] > 0.0 and r["residual"] < residual and r["tip_error"] < error for r in rows)
