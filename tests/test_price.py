"""The committed table `price`: what features that a scene does not use would cost it."""

import json

import pytest
from result_files import content_of, rows_of
from validation.price import measure
from validation.runner import main

import warpfea as wf
from warpfea.builder.scene import find, names

TRACES = {
    "contact": "contact", "contact between bodies": "pair", "constraints": "constraints",
    "follower pressure": "pressure", "moments": "moment_",
    "body forces": "field", "controls": "controls", "driven nodes": "drive", "damping explicit": "explicit",
    "damping rate": "rate", "damping incremental": "incremental", "table elements": "table",
    "straight elements": "affine",
}  # fmt: skip
"""Of a feature: what modules of scenes that have it name, and no others."""


FACETS_UNDER_OBSTACLES = {"overhang"}
"""Scenes in which points of obstacles, as narrow ones or edges, touch facets, but no bodies each other."""


def assert_priced(row):
    own, full = row["shipped"], row["all"]
    assert row["left"] == []
    assert len(row["forced"]) >= 10
    assert {"kernels", "modules"} <= set(own)
    for what in ("kernels", "modules"):
        assert len(own[what]) < 0.85 * len(full[what]), what
    for feature in set(TRACES) & set(row["forced"]):
        if feature == "contact" and "contact between bodies" not in row["forced"]:
            continue  # it has kernels of contact with obstacles too
        if feature == "contact between bodies" and row["scene"] in FACETS_UNDER_OBSTACLES:
            continue
        if feature == "damping incremental" and any("midpoint" in name for name in own["modules"]):
            continue  # by the midpoint rule it is that of the rate
        assert not [name for name in own["modules"] if TRACES[feature] in name], feature
        assert [name for name in full["modules"] if TRACES[feature] in name], feature
    for what in ("bytes", "launches", "unknowns"):
        assert own[what] < full[what], what
    assert row["moved"] < 1e-4  # both to the tolerance of the scene


def test_no_scene_pays_for_what_it_does_not_use():
    content = content_of("price_cpu.json", "warpfea bench --price --device cpu --out tests/results/price_cpu.json")
    assert content["settings"]["repeat"] >= 3
    assert [row["scene"] for row in content["rows"]] == list(names())
    for row in content["rows"]:
        assert_priced(row)
        own, full = row["shipped"]["ms_per_step"], row["all"]["ms_per_step"]
        assert row["ratio"] == pytest.approx(full / own)
        assert row["ratio"] > 1.0, row["scene"]


@pytest.mark.slow
def test_a_scene_is_priced_as_in_the_table(tmp_path, capfd):
    out = tmp_path / "price.json"
    words = ["--rows", "cantilever", "--set", "steps=2", "--set", "repeat=1", "--out", str(out)]
    assert main(["price", *words]) == 0
    assert "cantilever" in capfd.readouterr().out
    (row,) = json.loads(out.read_text())["rows"]
    assert_priced(row)


@pytest.mark.slow
def test_what_is_forced_in_is_all_that_the_scene_leaves_out():
    scene = find("slider_crank")
    row = measure(scene, device="cpu", steps=1, repeat=1)
    assert set(row["forced"]) == set(scene().finalize(device="cpu").info()["left_out"])
    assert row["left"] == []


@pytest.mark.parametrize("file", ["part_price_cpu.json", "part_price_h200.json"])
def test_a_rigid_part_costs_little(file):
    """One more part in scene `hook`, free and on a hinge: its step beside that of the scene alone."""
    found = {row["label"]: row for row in rows_of(file)}
    assert found["free"]["unknowns"] == found["hinged"]["unknowns"] == found["alone"]["unknowns"] + 12
    assert found["alone"]["ratio"] == 1.0
    assert max(row["ratio"] for row in found.values()) <= 1.3


def test_tiles_hold_the_constraints_of_a_part():
    """No launches correct the preconditioner for a part, free or on a hinge of the ground: the inverse of its tile has
    its constraints; for a part on a body they do."""
    for joined, corrections in ((False, 0), (True, 1)):
        b = wf.ModelBuilder()
        box = b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(2, 2, 2)), material=wf.SVK(E=1e6, nu=0.3, density=1e3))
        b.clamp(box.nodes("z-"))
        part = b.add_rigid(wf.Box((0.05, 0.05, 0.15), (0.1, 0.1, 0.1)), density=1e3)
        at = (0.05, 0.05, 0.1)
        b.add_joint("revolute", parent=box.at(at) if joined else wf.GROUND, child=part.at(at), axis=(1, 0, 0))
        solver = wf.NewtonPCG(preconditioner="tiles")
        sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3, solver=solver)
        assert len(sim.stepper.newton.preconditioner.corrections) == corrections
        sim.step(5)
        assert sim.totals["pcg"][0] <= (15, 30)[joined] * sim.totals["newton"][0]
