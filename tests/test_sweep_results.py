"""tests/results/sweep_cpu.json and sweep_h200.json, made by tests/sweep_cost.py."""

from result_files import content_of


def rows(name):
    """Rows of a file by part."""
    return {row["part"]: row for row in content_of(name)["rows"]}


def test_two_cores_do_nearly_twice_the_work():
    row = rows("sweep_cpu.json")["efficiency"]
    assert (row["designs"], row["workers"], row["failed"]) == (100, 2, 0)
    assert 0.5 < row["design_s"] < 2.0
    assert row["efficiency"] >= 0.9
    assert row["overhead_s"] < 5e-3


def test_the_driver_is_small():
    """A hundred thousand designs: bytes of the driver for each, and a table that is right."""
    row = rows("sweep_cpu.json")["many"]
    assert (row["designs"], row["failed"]) == (100_000, 0)
    assert row["bytes_per_design"] < 2000
    assert row["error"] < 1e-12


def test_a_sweep_has_the_bits_of_a_plain_batch_and_nearly_its_speed():
    row = rows("sweep_h200.json")["rate"]
    assert (row["worlds"], row["failed"]) == (65536, 0)
    assert row["ratio"] >= 0.9
    assert row["same_bits"]


def test_a_sweep_is_as_fast_as_a_plain_batch():
    assert rows("sweep_h200.json")["rate"]["ratio"] >= 0.95
