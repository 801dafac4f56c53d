"""The committed tables `contact_cost`: what contact costs beside a step without it."""

import numpy as np
import pytest
from result_files import content_of
from validation.contact_cost import BESIDE, SOLVES, solve_rows, start

FILES = {"contact_cpu.json": ("cpu", 8000, 1.3), "contact_h200.json": ("cuda", 100_000, 1.1)}
"""Device, unknowns at least, and most that a step may take over one without contact where the bodies are apart."""


def rows_of(name):
    """Of the smallest size that counts, by scene."""
    device, unknowns, _ = FILES[name]
    found = content_of(name, "warpfea bench --contact --device", device)["rows"]
    rows = {row["scene"]: row for row in reversed(found) if row["unknowns"] >= unknowns}
    assert set(rows) == {"none", "clamped", "apart", "resting", "sliding"}
    assert all(row["halvings"] == 0 for row in rows.values())
    return rows


@pytest.mark.parametrize("name", FILES)
def test_resting_and_sliding(name):
    rows = rows_of(name)
    for scene, bar in (("resting", 2.0), ("sliding", 3.0)):
        assert rows[scene]["ms_per_step"] <= bar * rows["clamped"]["ms_per_step"], scene
        assert rows[scene]["carried"] > 0.9, "it is not in touch"


@pytest.mark.parametrize("name", FILES)
def test_apart(name):
    rows = rows_of(name)
    assert rows["apart"]["newton_per_step"] == rows["none"]["newton_per_step"]
    assert rows["apart"]["ms_per_step"] <= FILES[name][2] * rows["none"]["ms_per_step"]


def assert_solves(rows):
    """Of one size."""
    mean = {(row["scene"], row["stiffness"]): np.mean(row["pcg"]) for row in rows}
    assert set(mean) == set(SOLVES)
    for (scene, stiffness), iterations in mean.items():
        if scene in BESIDE:
            assert iterations <= 1.3 * mean[BESIDE[scene], 1.0], (scene, stiffness)
    assert all(row["levels"] >= 2 for row in rows)


@pytest.mark.parametrize(
    ("name", "least", "most"),
    [("contact_cpu.json", 8e3, 2e4), ("contact_cpu.json", 8e4, 2e5), ("contact_h200.json", 8e4, 2e5)],
    ids=["10k", "100k", "100k, H200"],
)
def test_solves_take_few_more_iterations_than_with_contact_nodes_clamped(name, least, most):
    assert_solves([row for row in content_of(name)["solves"] if least < row["unknowns"] < most])


def test_solves_of_a_small_block():
    sims = {key: start(key[0], 4, "float64", "cpu", None, key[1]).sim for key in SOLVES}
    assert_solves(solve_rows(sims))
