"""Run times before and after every force became a term, made at 51a4e5d: medians of five alternated runs."""

import json
import pathlib

import pytest

RESULTS = pathlib.Path(__file__).resolve().parent / "results"
BEFORE = "bf679c2fb4f87bf423f74465b239d3a398e548db"
FILES = {"versions_h200.json": ("--peer", 1.05, 15), "versions_cpu.json": ("--cpu", 1.10, 20)}


@pytest.mark.parametrize("name", FILES)
def test_no_slower_than_before(name):
    bench, bar, least = FILES[name]
    content = json.loads((RESULTS / name).read_text())
    settings = content["settings"]
    assert content["command"].startswith("warpfea study versions --before")
    assert settings["bench"].split()[0] == bench
    assert settings["rounds"] >= 5
    assert settings["commits"]["before"][:40] == BEFORE
    assert len(settings["commits"]["now"]) >= 40
    assert content["machine"]["cpu"]
    assert content["versions"]["warp"]
    assert len(content["rows"]) >= least
    for row in content["rows"]:
        assert len(row["before_ms"]) == len(row["now_ms"]) == settings["rounds"]
        assert row["ratio"] <= bar, row["label"]
        for count in ("newton_per_step", "pcg_per_step"):
            assert row[count][0] == row[count][1], (row["label"], count)


def test_the_peers_problems_were_all_run():
    content = json.loads((RESULTS / "versions_h200.json").read_text())
    assert content["machine"]["gpu"].endswith("H200")
    assert len({row["label"] for row in content["rows"]}) == 15
