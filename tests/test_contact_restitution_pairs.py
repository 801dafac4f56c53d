"""Restitution of pairs by default beside `results/contact_restitution_pairs_cpu.json`, and that file beside theory."""

import pytest
from contact_restitution_pairs import bars
from result_files import content_of

FOUND = content_of("contact_restitution_pairs_cpu.json", "python tests/contact_restitution_pairs.py", "cpu")


@pytest.mark.parametrize("row", FOUND["bars"], ids=lambda row: f"{row['ratio']} {row['restitution']}")
def test_elastic_bars_rebound_by_their_waves(row):
    """Saint-Venant: the waves, not the contact, leave 1/ratio of the speed, after one passage of the shorter bar."""
    assert row["measured"] == pytest.approx(row["expected"], abs=0.03)
    assert row["duration"] == pytest.approx(row["expected_duration"], rel=0.08)
    assert row["momentum_error"] < 1e-10


def test_rigid_parts_rebound_with_the_restitution_of_their_contact():
    """Up to an error of first order in the step: 0.04 at a hundredth of the impact."""
    coarse, fine = (
        {r["restitution"]: r["measured"] for r in FOUND["rigid parts"] if r["dt"] == dt} for dt in (1e-4, 2.5e-5)
    )
    for e, measured in fine.items():
        assert measured == pytest.approx(e, abs=0.04)
        assert abs(measured + (measured - coarse[e]) / 3.0 - e) < 0.01
    assert all(row["momentum_error"] < 1e-10 for row in FOUND["rigid parts"])


@pytest.mark.slow
def test_the_rows_are_what_is_found_now():
    row = bars(1, 0.0, h=1e-3)
    assert row["measured"] == pytest.approx(0.929, abs=5e-3)
    assert row["momentum_error"] < 1e-10
