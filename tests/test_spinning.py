"""Generalized-alpha in bodies that turn: the default rho_inf adds no energy; what larger ones add is as recorded."""

import pytest
from result_files import rows_of
from validation.spinning import BODIES, MODULI, RADII, STEPS, TURNS, spin_energies, spinning_body

import warpfea as wf

DEFAULT = wf.GeneralizedAlpha().rho_inf


@pytest.fixture(scope="module")
def rows():
    return rows_of("spinning_cpu.json")


def test_every_setting_was_run(rows):
    found = {(r["body"], r["rho_inf"], r["E"], r["turn"]) for r in rows}
    assert found == {(b, rho, E, turn) for b in BODIES for rho in RADII for E in MODULI for turn in TURNS}


def test_the_default_never_adds_energy(rows):
    """With the default of 8934ce7, 0.8, energy grows 1390 times at 0.2 rad and 1e9 Pa."""
    mine = [r for r in rows if r["rho_inf"] <= DEFAULT]
    assert mine
    for row in mine:
        assert row["steps"] == STEPS, row
        assert row["growth"] <= 1.0 + 1e-6, row


def test_larger_ones_do(rows):
    """The default is not smaller than it must be: 0.4 and more fail within one radian a step."""
    worst = {rho: max(r["growth"] for r in rows if r["rho_inf"] == rho) for rho in RADII}
    assert all(worst[rho] > 2.0 for rho in RADII if rho >= 0.4)
    small = [r for r in rows if r["rho_inf"] == 0.8 and r["turn"] == 0.2 and r["E"] == 1e9 and r["body"] == "free"]
    assert small[0]["growth"] > 1e3


@pytest.mark.parametrize(("E", "turn"), [(1e7, 2.0), (1e9, 1.0)])
def test_the_default_holds_now(E, turn):
    found = spin_energies(spinning_body("free", E), "generalized_alpha", turn, BODIES["free"], 60)
    assert len(found) == 60
    assert max(found) <= 1.0 + 1e-6


def test_a_large_radius_is_still_told_apart():
    found = spin_energies(spinning_body("free", 1e9), wf.GeneralizedAlpha(rho_inf=0.8), 0.3, BODIES["free"], 60)
    assert max(found) > 1.5
