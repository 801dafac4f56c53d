"""Contact written once computes what contact written twice did: oracle.py, 20 steps."""

import pytest
from result_files import rows_of

ROWS = rows_of("oracle_cpu.json", "python tests/oracle.py --baseline abb108a")
TIGHT = rows_of("oracle_tight_cpu.json", "python tests/oracle.py --baseline abb108a")
TOUCHING = [label for label, row in ROWS.items() if not row["equal"]]
WITHOUT_CONTACT = ["cantilever", "chain", "double_pendulum", "four_bar", "hook", "hung_plate", "mixed", "pendulum",
                   "plate_pendulum", "rollup", "slider_crank", "spin", "twist", "backward_euler-none", "bdf2-none",
                   "energy_momentum-none", "generalized_alpha-none"]  # fmt: skip


@pytest.mark.parametrize("label", WITHOUT_CONTACT)
def test_without_contact_no_bit_launch_or_byte_differs(label):
    assert ROWS[label]["equal"]


@pytest.mark.parametrize("label", TOUCHING)
def test_displacements_with_contact(label):
    row = TIGHT.get(label, ROWS[label])  # two scenes end at other iterates within their own tolerance
    assert row["u difference"] <= 1e-9
    assert ROWS[label]["u difference"] <= 1e-7
    for count in ("launches", "bytes"):
        assert (row["present"].get(count) or 0) <= (row["baseline"].get(count) or 0)


@pytest.mark.parametrize("count", ["newton", "pcg"])
def test_iterations_with_contact(count):
    before, now = (sum(sum(ROWS[k][tree].get(count, [])) for k in TOUCHING) for tree in ("baseline", "present"))
    assert abs(now - before) <= 0.02 * before
