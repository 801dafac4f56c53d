"""`warpfea bench --peer`, the tables of costs in tests/validation, on tiny rows in this process."""

import json
import pathlib

import numpy as np
import pytest
from validation import cpu as bench_cpu
from validation import runner

from warpfea.cli import main
from warpfea.studies.bench import peer as bench_peer
from warpfea.studies.bench.problems import PROBLEMS

DATA = pathlib.Path(__file__).resolve().parent / "data"


@pytest.fixture
def bench(tmp_path, capfd):
    """Exit code, what was printed, what was written."""

    def run(*words):
        target = tmp_path / "out.json"
        todo = (main, "bench") if not words or words[0].startswith("-") else (runner.main,)
        device = () if "--device" in words else ("--device", "cpu")
        code = todo[0]([*todo[1:], *words, *device, "--out", str(target)])
        out, err = capfd.readouterr()
        return code, out + err, json.loads(target.read_text()) if target.exists() else None

    return run


def test_peer_measures_rows_by_label(bench):
    code, text, content = bench("--peer", "--rows", "plate-16x8,bar-3x2x1,beam-30", "--steps", "4")
    assert code == 0, text
    labels = ["bar-3x2x1", "beam-30", "plate-16x8"]
    assert content["settings"]["rows"] == labels
    assert {"schema", "command", "commit", "machine", "versions"} <= set(content)
    rows = content["rows"]
    assert [r["label"] for r in rows] == labels
    assert [r["unknowns"] for r in rows] == [315, 372, 1836]
    assert [r["free_unknowns"] for r in rows] == [270, 360, 1728]
    assert [r["elements"] for r in rows] == [36, 30, 128]
    assert [r["peer_ms"] for r in rows] == [2.46, 4.1, 10.7]
    for row in rows:
        assert row["dtype"] == "float64"
        assert row["required"] == 3.0
        assert row["speedup"] == pytest.approx(row["peer_ms"] / row["ms_per_step"])
        assert 1.0 <= row["newton_per_step"] <= row["pcg_per_step"]
        assert row["bytes_per_unknown"] > 100.0
        assert 0.0 < row["residual_force"] <= 5e-4
        assert 0.0 <= row["tip_difference"] < 1e-6  # 0: no iterate lies between the two tolerances
        assert row["label"] in text


def test_float32_is_judged_against_float64(bench):
    code, text, content = bench("--peer", "--rows", "bar-3x2x1", "--steps", "3", "--dtype", "float32")
    assert code == 0, text
    (row,) = content["rows"]
    assert row["dtype"] == "float32"
    assert 1e-9 < row["tip_difference"] < 1e-3


def test_what_has_no_peer_is_timed_for_a_few_steps(bench, monkeypatch):
    small = bench_peer.Case("bar-6x4x2", "bar", (6, 4, 2), 1755, None)
    monkeypatch.setattr(bench_peer, "LARGE_CASE", small)
    code, text, content = bench("--peer", "--large", "--rows", "bar-3x2x1", "--steps", "12")
    assert code == 0, text
    first, row = content["rows"]
    assert first["label"] == "bar-3x2x1"
    assert row["unknowns"] == small.unknowns
    assert (row["peer_ms"], row["speedup"], row["required"], row["tip_difference"]) == (None,) * 4
    assert content["settings"]["steps_without_peer"] == 10


def test_rows_without_their_mesh_are_left_out_and_named(bench, tmp_path):
    code, text, content = bench("--peer", "--rows", "bar-unstructured-*", "--meshes", str(tmp_path))
    assert code == 0, text
    assert content["rows"] == []
    assert "bar-unstructured-4567: left out" in text
    assert "bar_20822.npz" in text


def test_times_that_count():
    assert bench_peer.first_timed_step(120) == 20
    assert [bench_peer.first_timed_step(n) for n in (1, 2, 10)] == [1, 2, 6]


def test_table_of_the_peer():
    assert len({case.label for case in bench_peer.PEER_CASES}) == 15
    for case in (*bench_peer.PEER_CASES, bench_peer.LARGE_CASE):
        if case.problem == "bar" and not isinstance(case.size, str):
            assert case.unknowns == 3 * np.prod([2 * k + 1 for k in case.size])
        elif case.problem != "bar" and case.unknowns < 30_000:
            (body,) = PROBLEMS[case.problem].build(case.size).bodies
            assert case.unknowns == 3 * body.slot_count
    bars = {case.unknowns: bench_peer.required_speedup(case) for case in bench_peer.PEER_CASES}
    assert {n for n, bar in bars.items() if bar == 40.0} == {883227}
    assert {n for n, bar in bars.items() if bar == 3.0} == {n for n in bars if n < 100_000}
    assert set(bars.values()) == {3.0, 10.0, 40.0}


@pytest.mark.parametrize("case", [c for c in bench_peer.PEER_CASES if isinstance(c.size, str)], ids=lambda c: c.label)
def test_unstructured_meshes_are_as_large_as_the_peers(case):
    mesh = bench_peer.load_mesh(DATA / case.size)
    assert mesh.volume() == pytest.approx(6.0, rel=1e-14)
    assert mesh.straight_sided().all()
    assert 3 * len(mesh.points) == pytest.approx(case.unknowns, rel=0.02)
    assert len(mesh.cells) == pytest.approx(int(case.label.rpartition("-")[2]), rel=0.05)
    (body,) = PROBLEMS["bar"].build(mesh).bodies
    end = body.surface(lambda X: X[:, 0] > 3.0 - 1e-9)
    assert np.all(mesh.points[end.nodes][:, :, 0] == 3.0)


def test_cpu_steps_with_three_solvers(bench, monkeypatch):
    sizes = {"a": (1, 1, 1), "b": (3, 2, 1)}
    cases = [bench_cpu.CpuCase(f"bar-{k}", "bar", size, (1.0, 2.0)) for k, size in sizes.items()]
    monkeypatch.setattr(bench_cpu, "CASES", (*cases, bench_cpu.CpuCase("beam-1", "beam", 1)))
    code, text, content = bench("cpu", "--rows", "bar-*", "--set", "steps=3")
    assert code == 0, text
    rows = content["rows"]
    assert [(r["label"], r["solver"]) for r in rows] == [(f"bar-{k}", s) for k in sizes for s in bench_cpu.SOLVERS]
    for row in rows:
        assert (row["dtype"], row["steps"], row["note"]) == ("float64", 3, None)
        assert (row["chrono_1"], row["chrono_2"]) == (1.0, 2.0)
        assert 0.0 < row["residual_force"] <= 5e-4
        assert row["ms_per_step"] > 0.0
        assert row["unknowns"] == PROBLEMS["bar"].unknowns(sizes[row["label"][-1]])
    assert content["settings"]["time"] == "mean of all steps"


def test_cpu_leaves_out_what_takes_too_long(bench, monkeypatch):
    cases = [bench_cpu.CpuCase(f"bar-{k}", "bar", (k, 1, 1)) for k in (1, 2, 3)]
    monkeypatch.setattr(bench_cpu, "CASES", tuple(cases))
    code, text, content = bench("cpu", "--set", "steps=3", "--set", "limit_s=1e-9")
    assert code == 0, text
    rows = [r for r in content["rows"] if r["solver"] == "direct"]
    assert [r["steps"] for r in rows] == [1, 0, 0]
    assert rows[0]["note"].startswith("1 of 3 steps took")
    assert rows[1]["note"] == rows[2]["note"]
    assert "s per step with 54 unknowns" in rows[1]["note"]
    assert rows[1]["ms_per_step"] is None


def test_rows_of_the_cpu_are_as_large_as_they_say():
    for case in bench_cpu.CASES:
        kind, _, size = case.label.partition("-")
        if kind == "bar":
            assert PROBLEMS["bar"].unknowns(case.size) == pytest.approx(1000.0 * float(size[:-1]), rel=0.06)
    elements = {c.label: np.prod(c.size) for c in bench_cpu.CASES if c.problem != "bar"}
    expected = {"beam-256": 256, "beam-4096": 4096, "plate-16x16": 256, "plate-64x64": 4096, "brick-1080": 1080}
    assert elements == expected


def test_contact_stands_beside_a_step_without(bench):
    code, text, content = bench("contact_cost", "--set", "sizes=300", "--set", "steps=2", "--set", "repeat=1")
    assert code == 0, text
    rows = {row["scene"]: row for row in content["rows"]}
    assert set(rows) == {"none", "clamped", "apart", "resting", "sliding"}
    assert rows["apart"]["points"] == rows["resting"]["points"] > 0
    assert rows["none"]["points"] == rows["clamped"]["points"] == 0
    assert rows["apart"]["launches"] > rows["none"]["launches"]
    assert rows["apart"]["newton_per_step"] == rows["none"]["newton_per_step"]
    assert rows["apart"]["carried"] == 0.0
    assert rows["resting"]["carried"] > 0.1
    assert [rows[s]["bar"] for s in ("apart", "resting", "sliding")] == [1.3, 2.0, 3.0]
    assert {"schema", "command", "commit", "machine", "versions"} <= set(content)


BAD = {
    "unknown row": (["--peer", "--rows", "bar-1"], ["'bar-1'", "bar-3x2x1"]),
    "no such folder": (["--peer", "--meshes", "nowhere"], ["nowhere"]),
    "both": (["--peer", "--worlds"], ["--worlds", "--peer"]),
    "a kind that moved": (["--cpu", "--steps", "3"], ["--cpu", "tests.validation cpu"]),
    "a kind that is gone": (["--growth", "--steps", "3"], ["--growth", "tests/results"]),
    "rows alone": (["--rows", "bar-3x2x1"], ["--rows", "--peer"]),
    "sizes of the peer": (["--peer", "--unknowns", "1000"], ["--unknowns", "--peer"]),
    "steps of worlds": (["--worlds", "--steps", "3"], ["--steps", "--worlds"]),
    "unknown row of the CPU": (["cpu", "--rows", "bar"], ["bar"]),
    "another device": (["cpu", "--device", "cuda:0"], ["cpu"]),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_usage_is_named(bench, case):
    words, named = BAD[case]
    code, text, content = bench(*words)
    assert code == 2
    assert content is None
    for word in named:
        assert word in text
