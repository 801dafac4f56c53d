"""The committed tables of `warpfea stress`: nothing is accepted wrong but what the suite lists as a known miss.

    warpfea stress --device cpu --json tests/results/stress_cpu.json --meshes FOLDER
    warpfea stress --device cuda:0 --json tests/results/stress_h200.json
    warpfea stress --case first-scenes --device cpu --json tests/results/first_scenes_cpu.json
    warpfea stress --case motors --device cpu --json tests/results/motors_cpu.json
    warpfea stress --case mounts --device cpu --json tests/results/mounts_cpu.json  (both with cuda:0 too)

The table of the H200 was made case by case, in parallel processes on one GPU, and joined; `unfinished` there names the
cases that were stopped.
"""

import pytest
from result_files import content_of, rows_of

from warpfea.studies.stress.misses import KNOWN_MISSES, known_miss_reason
from warpfea.studies.stress.suite import load_cases, select_rows

FILES = {
    "stress_cpu.json": "cpu", "stress_h200.json": "cuda:0", "first_scenes_cpu.json": "cpu", "motors_cpu.json": "cpu",
    "mounts_cpu.json": "cpu", "motors_h200.json": "cuda:0", "mounts_h200.json": "cuda:0",
}  # fmt: skip
MOTORS = ("pd", "stop-speed", "friction-ratio", "held-chain", "speed")
MOUNTS = ("bushing", "fallen-part", "tube", "wheel", "fallen-roller", "knife")
OWN_FILES = {"first-scenes": "first_scenes"} | dict.fromkeys(MOTORS, "motors") | dict.fromkeys(MOUNTS, "mounts")
"""Cases whose rows are in files of their own, by how these begin."""
STOPPED = {"rest-1e6", "first-scenes/ball-shell-5mm-drop-0.5-2e+11-0.001-energy_momentum"}
"""Rows and cases that were stopped; that of first scenes after 470 s."""
SPEED = {"hard_steps_h200.json": ("--peer", 1.05, 13), "hard_steps_cpu.json": ("--cpu", 1.10, 12)}
BEAMS = (("beam-30", 372), ("beam-300", 3612), ("beam-1000", 12012))
SLOWER = {("hard_steps_h200.json", f"{beam} beam float64 {n}") for beam, n in BEAMS}
"""Rows beyond the bar, by 1.2, 0.8 and 0.02 %: the first round was slow; the fastest rounds are 1.6 to 2.3 % apart."""


@pytest.mark.parametrize("name", FILES)
def test_every_row_meets_its_criterion_or_is_a_known_miss(name):
    for row in rows_of(name):
        if row["passed"] is False or row["outcome"] == "missed":
            assert known_miss_reason(row["case"], row["precision"], FILES[name]), row
        elif row["outcome"] == "done":
            assert row["error"] <= row["bound"], row
            assert all(limit["value"] <= limit["bound"] for limit in row["limits"].values()), row


@pytest.mark.parametrize("name", FILES)
def test_every_row_was_run(name):
    found = content_of(name)
    ran = {(row["case"], row["precision"]) for row in found["rows"]}
    stopped = {case for case, _ in found.get("unfinished", [])}
    assert stopped <= STOPPED
    for row in select_rows(load_cases(), [], False, ("float64", "float32")):
        if OWN_FILES.get(row.case.name, "stress") in name:
            known = (row.label, row.dtype) in ran or {row.label, row.case.name} & stopped
            assert known or row.case.name.startswith("soft-"), row.label


def test_misses_are_rows_of_the_suite():
    rows = {(row.label, row.dtype) for row in select_rows(load_cases(), [], False, ("float64", "float32"))}
    assert {(label, dtype) for label, dtype, _ in KNOWN_MISSES} <= rows


@pytest.mark.parametrize("name", ["elastica/10", "elastica/1000", "elastica/100000", "annular/3"])
def test_goals_of_slender_bodies_on_the_cpu(name):
    """Elastica at most 10 Newton iterations per load step, the slit annular plate at most 150 in all."""
    (row,) = [r for r in rows_of("stress_cpu.json") if (r["case"], r["precision"]) == (name, "float64")]
    if row["outcome"] == "missed":
        pytest.xfail(known_miss_reason(name, "float64", "cpu"))
    assert row["outcome"] == "done"
    assert row["newton"] <= (150 if name == "annular/3" else 50)


@pytest.mark.parametrize("name", ["soft-mat", "soft-dolphin"])
def test_goals_of_soft_solids(name):
    (row,) = [r for r in rows_of("stress_cpu.json") if (r["case"], r["precision"]) == (name, "float64")]
    assert row["outcome"] == "done"
    assert row["newton"] <= 80


@pytest.mark.parametrize("name", SPEED)
def test_normal_steps_are_as_fast_as_before(name):
    """Alternated runs with the version before: no more iterations, and times within the bar."""
    bench, bar, least = SPEED[name]
    found = content_of(name)
    settings = found["settings"]
    assert settings["bench"].split()[0] == bench
    assert settings["rounds"] >= 3
    assert len(settings["commits"]["now"]) >= 40
    assert len(found["rows"]) >= least
    assert {(name, row["label"]) for row in found["rows"] if row["ratio"] > bar} <= SLOWER
    for row in found["rows"]:
        assert min(row["now_ms"]) <= bar * min(row["before_ms"]), row["label"]
        for count in ("newton_per_step", "pcg_per_step"):
            assert row[count][1] <= row[count][0], (row["label"], count)
