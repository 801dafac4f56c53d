"""The table `product` on tiny problems: its operators are H, its counts are those of the tables."""

import json
import types

import numpy as np
import pytest
from validation import product as bench_product
from validation.product_cost import cost
from validation.runner import main

from warpfea.studies.bench.problems import LAW, PROBLEMS

SIZES = {"bar": (2, 1, 1), "beam": 2, "plate": 1, "ENMC": (1, 1, 1), "FN18": (1, 1, 1)}


def model_of(name, dtype="float64"):
    """A small model without damping."""
    return PROBLEMS[name].build(SIZES[name], law=LAW).finalize(device="cpu", dtype=dtype)


@pytest.mark.parametrize("name", SIZES)
def test_both_operators_are_the_matrix_of_the_step(name):
    model = model_of(name)
    got = {}
    for operator in ("elements", "matrix"):
        sim, residual = bench_product.prepare(model, operator)
        assert residual.by_matrix == (operator == "matrix")
        _, direction, out = bench_product.apply(model, residual)
        got[operator] = out.numpy()[0]
    state = model.state()
    state.displacement.assign(sim.stepper.work.u)
    assert np.abs(sim.stepper.work.u.numpy()).max() > 0.0
    p, dt = direction.numpy()[0], bench_product.DT
    expected = model.mass_host @ p / dt + dt * (model.tangent_matrix(state) @ p.ravel()).reshape(-1, 3)
    expected *= model.free_host
    for value in got.values():
        assert np.abs(value - expected).max() < 1e-11 * np.abs(expected).max()


def test_bytes_and_operations_of_straight_tetrahedra():
    model = model_of("bar")
    _, residual = bench_product.prepare(model, "elements")
    bench_product.apply(model, residual)
    E, S, Q, n, w = model.info()["elements"], 10, 4, model.slots, 8
    C, v = E * S, 3 * 8
    assert E <= 64  # one cluster: a sum for each slot, room for 32 S slots, two 16-bit numbers for each of 64 S places
    cluster = 4 * (2 + 2 + 32 * S) + 4 * (64 * S + 16 * S + 4)
    elements = 11 * w * E + 4 * E + 2 * v * n + v * n + cluster
    slots = 4 * (n + 1) + 4 * n + v * n + (2 * v + 1) * n + 8 * n  # on the CPU a row per slot
    tables = w * (3 * S * Q + Q + S * S + S + 11)  # gradients, weights, mass, kinds of slots, coefficients
    counted = cost(residual)
    assert counted.bytes == elements + slots + tables
    assert counted.flops == E * (Q * (96 + 305 + 136) + 480) + 3 * C + 3 * n + 10 * n


def test_bytes_of_the_matrix():
    model = model_of("plate", "float32")
    _, residual = bench_product.prepare(model, "matrix")
    bench_product.apply(model, residual)
    n, m = model.slots, residual.assembled.pattern.entries
    assert cost(residual).bytes == 4 * (n + 1) + (4 + 36) * m + (2 * 12 + 1) * n + 8 * n


def test_product_measures_both_operators(tmp_path, capfd):
    target = tmp_path / "out.json"
    assert (
        main(["product", "--set", "problems=beam", "--set", "sizes=24", "--set", "repeat=1", "--out", str(target)]) == 0
    )
    text = capfd.readouterr().out
    content = json.loads(target.read_text())
    assert {"schema", "command", "commit", "machine", "versions", "settings"} <= set(content)
    rows = content["rows"]
    assert [(r["dtype"], r["operator"]) for r in rows] == [
        (dtype, operator) for dtype in ("float64", "float32") for operator in ("matrix", "elements")
    ]
    for row in rows:
        assert row["chosen"] == (row["operator"] == "matrix")  # on the CPU
        assert row["unknowns"] == 24
        assert row["unknowns_per_s"] == pytest.approx(24e3 / row["ms"])
        assert row["GBps"] == pytest.approx(1e-9 * row["bytes_per_unknown"] * row["unknowns_per_s"])
        assert row["bandwidth_share"] == pytest.approx(row["GBps"] / row["copy_GBps"])
        assert row["Gflops"] == pytest.approx(1e-9 * row["flops_per_unknown"] * row["unknowns_per_s"])
        assert (row["peak_Gflops"], row["limit"], row["limit_share"]) == (None, None, None)
        assert row["memory_per_unknown"] > row["bytes_per_unknown"]
        assert row["operator"] in text


def test_peaks_by_name():
    def device(name, is_cuda=True):
        return types.SimpleNamespace(is_cuda=is_cuda, name=name)

    assert bench_product.peak(device("NVIDIA H200"), "float64") == 34e3
    assert bench_product.peak(device("NVIDIA H200"), "float32") == 67e3
    assert bench_product.peak(device("NVIDIA GeForce RTX 4090"), "float32") is None
    assert bench_product.peak(device("H200", is_cuda=False), "float32") is None


@pytest.mark.parametrize("name", [*SIZES, "H3843"])
def test_unknowns_of_a_size(name):
    size = PROBLEMS[name].size_for(1000)
    model = PROBLEMS[name].build(size).finalize(device="cpu")
    assert PROBLEMS[name].unknowns(size) == model.info()["unknowns"]
    assert PROBLEMS[name].unknowns(size) == pytest.approx(1000, rel=0.3)
