"""The result of `python -m tests.validation contact` on a wall and a turntable, short runs: friction holds bodies."""

import pytest
from result_files import content_of
from validation.contact import turntable_case, wall_case


@pytest.fixture(scope="module")
def result():
    content = content_of("contact_rest_cpu.json", "warpfea study contact --only wall --only turntable --out ", "cpu")
    assert content["settings"]["cube"] == {"edge": 0.1, "mass": 1.0, "nu": 0.3, "tol": 1e-10}
    return content


def assert_still(row):
    assert row["moved"] < 1e-11
    assert row["force"] == pytest.approx([20.0, 0.0, 9.81], rel=1e-6, abs=1e-6)
    assert abs(row["ledger_residual"]) < 1e-9


def assert_stuck(row):
    assert row["moved"] < 1e-5
    assert max(row["moved_by_turn"]) < 1e-5
    assert abs(row["ledger_residual"]) < 1e-7  # J, of 0.1 J in motion, over thousands of steps at tol 1e-10


def assert_walking(row):
    """Eq. (78) does not turn the spring with the bodies: stated among the defects of the paper's law."""
    assert 1e-4 < row["moved"] < 0.1


def test_a_block_pressed_to_a_wall_does_not_creep(result):
    assert [row["element"] for row in result["wall"]] == ["T4", "T10"]
    for row in result["wall"]:
        assert row["settle_s"] == row["hold_s"] == 10.0
        assert row["dt"] == 1e-2
        assert row["steps"] == 2000
        assert_still(row)


def test_a_stuck_block_stays_on_a_turning_plate_for_ten_turns(result):
    default, paper = result["turntable"]
    assert (default["law"], paper["law"]) == ("default", "paper")
    assert default["turns"] == len(default["moved_by_turn"]) == 10
    assert_stuck(default)
    assert_walking(paper)


@pytest.mark.parametrize("element", ["T4", "T10"])
def test_a_block_pressed_to_a_wall_is_still_after_two_seconds(element):
    assert_still(wall_case(element, settle=2.0, hold=1.0))


def test_a_stuck_block_stays_on_a_turning_plate_for_two_turns():
    assert_stuck(turntable_case("default", turns=2))


def test_the_papers_law_walks_on_a_turning_plate():
    assert_walking(turntable_case("paper", turns=2))
