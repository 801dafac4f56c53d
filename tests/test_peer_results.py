"""The committed table of `warpfea bench --peer --large` on one H200 holds its bars."""

import json
import pathlib

import pytest

from warpfea.studies.bench.peer import LARGE, PEER, required

RESULTS = pathlib.Path(__file__).resolve().parent / "results"


@pytest.fixture(scope="module")
def peer():
    content = json.loads((RESULTS / "peer_h200.json").read_text())
    assert content["command"].startswith("warpfea bench --peer")
    assert len(content["commit"]) >= 40
    assert content["machine"]["gpu"].endswith("H200")
    assert content["versions"]["warp"]
    return content


def test_peer_table_is_whole_and_follows_the_protocol(peer):
    settings = peer["settings"]
    assert (settings["dt"], settings["steps"], settings["first_step_timed"]) == (1e-3, 120, 20)
    assert (settings["force_tol"], settings["tip_after_step"]) == (5e-4, 100)
    assert settings["reference_tolerance_factor"] == 0.1
    rows = [row for row in peer["rows"] if row["dtype"] == "float64"]
    assert [row["label"] for row in rows] == [case.label for case in (*PEER, LARGE)]


@pytest.mark.parametrize("case", PEER, ids=[case.label for case in PEER])
def test_faster_than_the_peer_at_the_stated_residual(peer, case):
    (row,) = (r for r in peer["rows"] if r["label"] == case.label and r["dtype"] == "float64")
    assert row["peer_ms"] == case.peer_ms
    assert row["unknowns"] == pytest.approx(case.unknowns, rel=0.02)
    assert row["residual_force"] <= 5e-4
    assert row["tip_difference"] <= 1e-6
    assert row["speedup"] == pytest.approx(case.peer_ms / row["ms_per_step"])
    assert row["speedup"] >= required(case)


def test_four_million_unknowns_tell_their_memory(peer):
    (row,) = (r for r in peer["rows"] if r["label"] == LARGE.label and r["dtype"] == "float64")
    assert row["unknowns"] == LARGE.unknowns
    assert row["residual_force"] <= 5e-4
    assert row["ms_per_step"] > 0.0
    assert row["bytes_per_unknown"] > 0.0
