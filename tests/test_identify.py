"""`warpfea study identify`: stiffness and damping from a noisy record; tests/results/identify_cpu.json, made by it."""

import numpy as np
import pytest
from result_files import content_of

from warpfea.studies.identify import NOISE_RATIO, TRUE_CONSTANTS, identify, record_tip


@pytest.mark.parametrize(("device", "worlds"), [("cpu", 64), ("h200", 4096)])
def test_the_committed_search_finds_both(device, worlds):
    found = content_of(f"identify_{device}.json")
    (row,) = found["rows"]
    assert row["worlds"] == worlds
    assert found["settings"]["truth"] == TRUE_CONSTANTS
    assert row["noise"] == NOISE_RATIO == 0.01
    assert row["E_error"] < 0.02
    assert row["eta_error"] < 0.02
    assert row["misfit"] == pytest.approx(NOISE_RATIO, rel=0.3)  # what is left is the noise
    assert row["time_s"] > 0.0


def test_gradients_find_both_in_few_motions():
    """The misfit of 65 536 motions, and without noise the constants."""
    noisy, exact = content_of("identify_gradients_cpu.json")["rows"]
    assert noisy["misfit"] <= 0.009276
    assert max(noisy["runs"], noisy["backward_runs"]) <= 30
    assert max(exact["runs"], exact["backward_runs"]) <= 30
    assert max(exact["E_error"], exact["eta_error"]) < 1e-6
    assert (noisy["noise"], exact["noise"]) == (NOISE_RATIO, 0.0)


def test_a_small_search_gets_near():
    found = identify(record_tip("cpu"), device="cpu", worlds=8, generations=3)
    assert (found.runs, found.unknowns) == (24, 216)
    assert found.E_error < 0.5
    assert found.misfit < 0.2


def test_the_record_is_noisy():
    one, other = record_tip("cpu", t_end=0.02, seed=1), record_tip("cpu", t_end=0.02, seed=2)
    assert one.shape == (10, 3)
    assert 0.0 < np.abs(one - other).max() < 0.1 * np.abs(one).max()
