"""Uses of gradients: their cost, and the examples of warpfea/simulation/EXAMPLES.md."""

import pytest
from result_files import RESULTS, content_of

MAX_RATIO = 1.0  # of symmetric operators; 2.5 of others
FILES = [
    ("cpu", 1),
    pytest.param(
        "h200",
        4096,
        marks=pytest.mark.xfail(
            not (RESULTS / "gradient_cost_h200.json").exists(), reason="not measured yet", strict=True
        ),
    ),
]


@pytest.mark.parametrize(("device", "worlds"), FILES)
def test_a_step_back_costs_no_more_than_one_forward(device, worlds):
    content = content_of(f"gradient_cost_{device}.json", "python tests/gradient_cost.py")
    rows = {row["label"]: row for row in content["rows"]}
    assert {"pendulum", "finger", "gripper"} == set(rows)
    assert content["settings"]["seconds"] < 60.0
    for name in ("pendulum", "finger"):
        assert rows[name]["worlds"] == worlds
        assert rows[name]["ratio"] <= MAX_RATIO, name
        assert rows[name]["recomputed"] == 0
    grip = rows["gripper"]
    assert "contact" in grip["refused"] if "refused" in grip else grip["ratio"] <= 2.5
