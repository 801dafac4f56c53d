"""Speeds on one H200 beside those of 8934ce7, in turn on one machine, as tests/results/trials_h200.json says."""

import json
import pathlib

import numpy as np

FILE = pathlib.Path(__file__).resolve().parent / "results" / "trials_h200.json"


def test_no_row_is_slower_by_more_than_five_percent():
    assert FILE.exists(), f"{FILE} is missing: it names the commands that made it"
    content = json.loads(FILE.read_text())
    assert len(content["commit"]) == len(content["baseline"]) == 40
    assert "H200" in content["machine"]["gpu"]
    assert len(content["rows"]) >= 12
    for row in content["rows"]:
        assert np.median(row["ms"]) <= 1.05 * np.median(row["baseline_ms"]), row
        assert row["tip_error"] is None or row["tip_error"] < 1e-6, row
