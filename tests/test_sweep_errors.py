"""Sweeps: errors of machines, files that change, engines after an error, designs short of quality, refused fits."""

import csv
import time

import pytest
from test_sweep import BAR, DESIGN, FALL, Inline

import warpfea as wf
from warpfea.outputs.animation import Animation
from warpfea.sweeps import PoolEngine
from warpfea.sweeps.worker import Group


def test_errors_of_the_machine_are_no_failures_of_designs(monkeypatch):
    """Twice its disk is full: the designs are done again, and have their results."""
    left, batch = [0, 0], Group.batch

    def full(self, designs, columns):
        if left:
            left.pop()
            raise OSError("No space left on device")
        return batch(self, designs, columns)

    monkeypatch.setattr(Group, "batch", full)
    rows = [{"gravity.z": -1.0 * k} for k in range(4)]
    result = wf.sweep(FALL, rows, measures={"z": "probe.p.displacement.z"}, engine=Inline(1))
    assert (result.failures, result.retries) == ({}, 2)
    left.extend([0] * 20)
    result = wf.sweep(FALL, rows[:1], measures={"z": "probe.p.displacement.z"}, engine=Inline(1))
    assert result.failures == {0: "its worker failed 3 times: OSError: No space left on device"}


class Editing(Inline):
    """The user edits the file once the sweep runs."""

    def __init__(self, file):
        super().__init__(1)
        self.file = file

    def submit(self, call, *arguments):
        self.file.write_text("def half(sim):\n    return 0.0\n")
        return super().submit(call, *arguments)


def test_a_file_that_changes_is_told(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text("def half(sim):\n    return 0.5\n")
    with pytest.raises(wf.CheckpointError, match=r"mine.py: has changed since the sweep began"):
        wf.sweep(FALL, [{"size": 1.0}], measures={"h": f"{file}:half"}, engine=Editing(file))
    assert wf.sweep(FALL, [{"size": 1.0}], measures={"h": f"{file}:half"}, engine=Inline())["h"] == [0.0]


def test_times_that_cannot_be_written_are_told(tmp_path):
    (tmp_path / "times.csv").mkdir()
    with pytest.raises(wf.OutputError, match=r"times.csv: can't be written"):
        wf.sweep(FALL, DESIGN, measures={"z": "energy.strain"}, engine=Inline(), out=tmp_path)


def test_the_sheet_has_one_scale(tmp_path, monkeypatch):
    """The colours of all its pictures are those of the extremes of all."""
    rows, drawn, draw = [{"gravity.z": g} for g in (-1.0, -4.0)], [], Animation.draw
    result = wf.sweep(BAR, rows, measures={"s": "field.von_mises"}, run={"t_end": 0.01}, engine=Inline(), out=tmp_path)
    monkeypatch.setattr(
        Animation, "draw", lambda self, *given: drawn.append(self.color_limits(given[-1])) or draw(self, *given)
    )
    result.sheet(tmp_path / "sheet.png", field="von_mises")
    assert drawn[0] == drawn[1]
    assert drawn[0][1] == pytest.approx(result["s"].max(), rel=1e-5)


def test_a_fit_tells_its_progress(capfd):
    record = {"probe.tip.displacement.z": ([0.005], [-1e-4])}
    wf.fit(BAR, {"gravity.z": (-9.0, -1.0)}, record, worlds=2, generations=2, run={"device": "cpu"}, progress=True)
    assert "fit" in (told := capfd.readouterr()[1])
    assert "misfit" in told


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"design": [{"size": 10**400}]}, "design: a whole number of more than 64 bits"),
        ({"design": [{"size": 1.0, "gravity.z": 1.0}, {"size": 1.0}]}, r"design\[1\].gravity.z is missing"),
        ({"measures": {3: "energy.strain"}}, "measures: the name 3 must be a text"),
        ({"measures": {"\ud800": "energy.strain"}}, "measures: the name .* must be a text that can be printed"),
        ({"design": {"kind": "random", "count": 2, "over": {"size": [-1.7e308, 1.7e308]}}}, "high - low is too large"),
        ({"design": {"kind": "random", "count": 2, "over": {"size": {"low": 0.2, "high": 0.8, "whole": True}}}},
         "design.over.size: low and high of whole numbers must be whole"),
    ],
)  # fmt: skip
def test_extreme_input_is_refused(change, message):
    with pytest.raises(wf.ModelError, match=message):
        wf.sweep(FALL, **{"design": DESIGN, "measures": {"z": "energy.strain"}, "engine": Inline(), **change})


def test_a_folder_that_the_system_refuses():
    with pytest.raises(wf.OutputError, match="can't be made"):
        wf.sweep(FALL, DESIGN, measures={"z": "energy.strain"}, engine=Inline(), out="x" * 300)


def test_a_measure_that_ends_the_process_fails(tmp_path):
    """Neither worker nor driver ends."""
    (tmp_path / "mine.py").write_text("import sys\ndef leave(sim):\n    sys.exit(3)\n")
    result = wf.sweep(FALL, [{"size": 1.0}], measures={"h": f"{tmp_path}/mine.py:leave"}, engine=Inline())
    assert "measure 'leave': SystemExit: 3" in result.failures[0]


@pytest.mark.parametrize("method", ["least_squares", "differential_evolution"])
def test_a_fit_whose_runs_are_refused(method):
    record = {"probe.tip.displacement.z": ([0.005], [0.0])}
    how = {"method": method, "worlds": 4, "generations": 2, "run": {"device": "cpu"}}
    with pytest.raises(wf.ConvergenceError, match=r"the run of the (start|best candidate) is refused, at gravity.z"):
        wf.fit(BAR, {"gravity.z": (-2e9, -1e9)}, record, **how)


def test_another_file_is_not_erased(tmp_path):
    path = tmp_path / "record.jsonl"
    path.write_text('{"mine": 1}\n')
    with pytest.raises(wf.CheckpointError, match="is there"):
        wf.sweep(FALL, DESIGN, measures={"z": "energy.strain"}, engine=Inline(), out=tmp_path)
    assert path.read_text() == '{"mine": 1}\n'


def test_an_engine_can_be_used_after_an_error():
    pool = PoolEngine(1)
    try:
        pool.submit(time.sleep, 60)
        pool.reset()
        assert pool.result(pool.submit(abs, -1)) == 1
    finally:
        pool.close()


def test_designs_short_of_quality_are_listed(tmp_path):
    """A measure that is infinite has no value, in JSON null; steps above the tolerance are counted."""
    file = tmp_path / "mine.py"
    file.write_text("def h(sim):\n    sim.totals['rough'][2] = 4\n    return [1.0, float('inf'), 3.0, 2.0]\n")
    rows = [{"gravity.z": -1.0 * k} for k in range(4)]
    result = wf.sweep(FALL, rows, measures={"h": f"{file}:h"}, engine=Inline(1), run={"device": "cpu"})
    assert result.failures == {1: "h: not finite", 2: "4 steps above the tolerance"}
    assert result.status == {1: "no value", 2: "unconverged steps"}
    assert '{"h": null}' in (result.folder / "record.jsonl").read_text()
    assert result.best("h", largest=True)["design"] == 3


@pytest.mark.parametrize("values", [[2.5], ["2"], [2, "two"]])
def test_values_of_another_type_are_refused_before_the_run(tmp_path, values):
    with pytest.raises(wf.ModelError, match=r"design.over.cells: .* is not of type int"):
        wf.sweep(
            "cantilever", {"over": {"cells": values}}, measures={"u": "energy.strain"}, engine=1, out=tmp_path / "s"
        )
    assert not (tmp_path / "s" / "table.csv").exists()


@pytest.mark.parametrize(
    ("axis", "start", "words"),
    [
        ({"low": 1e5, "high": 1e9}, {"E": 1e6}, "start.E is unknown; there are bar.E"),
        ({"low": 1e5, "high": 1e9}, {"bar.E": 1e4}, "start.bar.E = 10000.0 is not in its range"),
        ({"low": 1, "high": 9, "whole": True}, {}, "whole and count are of designs"),
    ],
)
def test_bad_starts_and_ranges_of_a_fit_are_refused(axis, start, words):
    record = {"probe.tip.displacement.z": ([0.01], [0.0])}
    with pytest.raises(wf.ModelError, match=words):
        wf.fit("cantilever", {"bar.E": axis}, record, method="least_squares", start=start)


def test_names_of_any_kind(tmp_path):
    """The record and the tables take them as they are."""
    name = 'tip, "100 %s" {, ' + "\N{GREEK SMALL LETTER DELTA}" * 200
    how = {"measures": {name: "probe.p.displacement.z"}, "engine": Inline(1), "out": tmp_path / "two words \N{SNOWMAN}"}
    design = {"over": {"gravity.z": [-1.0, -2.0]}}
    first = wf.sweep(FALL, design, **how)
    assert (first[name] == wf.sweep(FALL, design, **how, resume=True)[name]).all()
    assert first[name] == pytest.approx([-6e-4, -12e-4], rel=1e-9)
    with open(first.folder / "table.csv", encoding="utf-8", newline="") as file:
        assert name in next(csv.reader(file))
