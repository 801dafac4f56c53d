"""The study of dt="auto" in tests/results: true errors beside those asked, and iterations beside fixed steps."""

from __future__ import annotations

import json
import pathlib

import numpy as np
import pytest
from adaptive_bars import SCHEMES

RESULT = pathlib.Path(__file__).resolve().parent / "results" / "adaptive_cpu.json"
SMOOTH = ("stiff", "dead_points", "free_flight")
STRUCK = ("impact", "contact")
SCENES = (*SMOOTH, *STRUCK, "soft_contact")
ERRORS = (1e-2, 1e-3, 1e-4, 1e-5)
NOT_RUN = {("impact", "backward_euler", 1e-4), ("impact", "backward_euler", 1e-5), ("contact", "backward_euler", 1e-5)}
"""They would take 3e5, 3e6 and 1e5 steps."""


def study(scene, integrator):
    content = json.loads(RESULT.read_text())
    return [row for row in content["adaptive"] if (row["scene"], row["integrator"]) == (scene, integrator)]


@pytest.mark.parametrize("scene", SCENES)
def test_references_are_ten_times_finer_than_what_they_judge(scene):
    """A run for a quarter of the error has at most a third of the difference left."""
    content = json.loads(RESULT.read_text())
    (own,) = [row["own_error"] / 3.0 for row in content["references"] if row["scene"] == scene]
    assert 10.0 * own <= min(row["true"] for row in content["adaptive"] if row["scene"] == scene)


@pytest.mark.parametrize("integrator", SCHEMES)
@pytest.mark.parametrize("scene", SCENES)
def test_true_errors_keep_to_those_asked(scene, integrator):
    rows = study(scene, integrator)
    assert len(rows) >= 2
    for row in rows:
        assert 0.01 <= row["true"] / row["asked"] <= 5.0


@pytest.mark.parametrize("integrator", SCHEMES)
@pytest.mark.parametrize("scene", SCENES)
def test_true_errors_fall_as_those_asked(scene, integrator):
    rows = study(scene, integrator)
    slope = np.polyfit(np.log([row["asked"] for row in rows]), np.log([row["true"] for row in rows]), 1)[0]
    assert 0.8 <= slope <= 1.2


COSTLY = {
    ("impact", "backward_euler"): (
        {1e-2, 1e-3},
        "1.06, 0.75: the flight after the blow alone takes 0.70 and 0.40, with the steps that the best fixed one has",
    ),
    ("contact", "bdf2"): (
        {1e-2},
        "1.92: 16 and 32 fixed steps, longer than the contact, are at 1.4e-2 and 6.7e-3 by chance, 64 at 2.6e-2",
    ),
}
"""Misses of the iterations asked for: errors, and factors."""


def costs():
    for scene in SMOOTH + STRUCK:
        for integrator in SCHEMES:
            missed, reason = COSTLY.get((scene, integrator), (set(), ""))
            for error in ERRORS:
                if (scene, integrator, error) not in NOT_RUN:
                    marks = [pytest.mark.xfail(strict=True, reason=reason)] if error in missed else []
                    yield pytest.param(scene, integrator, error, marks=marks)


@pytest.mark.parametrize(("scene", "integrator", "error"), list(costs()))
def test_newton_iterations_beside_the_best_fixed_step(scene, integrator, error):
    """At most 1.5 times those of the best fixed step on smooth motions, 0.7 times with an impact."""
    (row,) = [row for row in study(scene, integrator) if row["asked"] == error]
    assert row["cost"] <= (1.5 if scene in SMOOTH else 0.7), row
