"""Sweeps: designs, measures, bits over batches, failures, the record."""

import functools
import json
import pathlib
import random
import runpy
import subprocess
import sys

import numpy as np
import pytest
import sweep_models

import warpfea as wf
from warpfea.sweeps import PoolEngine, WorkerLost
from warpfea.sweeps.measures import parse_measure
from warpfea.sweeps.worker import Group

MODELS = pathlib.Path(sweep_models.__file__).resolve()
BAR, FALL = f"{MODELS}:bar", f"{MODELS}:fall"
TIP = {"tip": "probe.tip.displacement.z", "sag": "max probe.tip.displacement.norm", "stress": "field.von_mises.bar"}
STIFF = 10.0 ** np.random.default_rng(3).uniform(5, 7, 64)
SHORT = {"t_end": 0.03, "device": "cpu"}


class Inline:
    """An engine in this process: calls are done when they are asked for, in a seeded order; some workers die."""

    def __init__(self, workers=3, seed=0, deaths=0.0):
        self.workers, self.random, self.deaths = workers, random.Random(seed), deaths

    def submit(self, call, *arguments):
        return functools.partial(call, *arguments)

    def done(self, handles):
        return [self.random.choice(list(handles))]

    def result(self, handle):
        if self.random.random() < self.deaths:
            raise WorkerLost("by chance")
        return handle()


@pytest.fixture(scope="module")
def pool():
    engine = PoolEngine(1)
    yield engine
    engine.close()


def table(result):
    return (result.folder / "table.csv").read_text()


# designs


def test_grid_and_list(tmp_path):
    design = wf.Design.grid({"cells": [2, 3], "E": {"low": 1.0, "high": 100.0, "count": 3, "log": True}})
    assert design.columns == {"cells": [2, 2, 2, 3, 3, 3], "E": [1.0, pytest.approx(10.0), 100.0] * 2}
    (tmp_path / "d.csv").write_text("cells,E,gravity,name\n2,1e5,0 0 -1,soft\n3,2,1 0 0,stiff\n")
    read = wf.Design.read(tmp_path / "d.csv")
    assert read[0] == {"cells": 2, "E": 1e5, "gravity": (0.0, 0.0, -1.0), "name": "soft"}
    assert [type(x) for x in read.columns["E"]] == [float, int]


@pytest.mark.parametrize("kind", ["random", "lhs", "sobol"])
def test_samples_fill_their_ranges(kind):
    over = {"E": {"low": 1e5, "high": 1e7, "log": True}, "nu": (0.0, 0.4), "n": {"low": 2, "high": 5, "whole": True}}
    one, same = (wf.Design.samples(kind, over, count=48, seed=4) for _ in range(2))
    other = wf.Design.samples(kind, over, count=48, seed=5)
    assert one.columns == same.columns
    assert one.columns != other.columns
    assert all(1e5 <= x <= 1e7 for x in one.columns["E"])
    assert set(one.columns["n"]) == {2, 3, 4, 5}
    if kind != "random":  # each half of a range holds half of the designs, as evenly as 48 of them may
        assert abs(sum(x < 1e6 for x in one.columns["E"]) - 24) <= 8
        assert abs(sum(x < 0.2 for x in one.columns["nu"]) - 24) <= 8


def test_parquet(tmp_path):
    pytest.importorskip("pyarrow.parquet")
    import pyarrow as arrow

    arrow.parquet.write_table(arrow.table({"cells": [2, 3], "E": [1.5, 2.5]}), tmp_path / "d.parquet")
    assert wf.Design.read(tmp_path / "d.parquet").columns == {"cells": [2, 3], "E": [1.5, 2.5]}
    result = wf.sweep(FALL, [{"size": 1.0}, {"size": 2.0}], measures={"z": "probe.p.displacement.z"}, engine=Inline())
    stored = arrow.parquet.read_table(result.folder / "table.parquet").to_pydict()
    assert stored["z"] == result["z"].tolist()
    assert stored["size"] == [1.0, 2.0]


# results


def test_results_are_those_of_single_runs():
    """Against simulations made by hand, one of each design, bit for bit."""
    rows = [{"cells": cells, "bar.E": E, "gravity.z": g} for cells in (2, 3) for E, g in ((1e5, -9.81), (1e6, -5.0))]
    series = {"z": "probe.tip.displacement.z"}
    result = wf.sweep(BAR, rows, measures={**TIP, "e": "energy.strain"}, series=series, run=SHORT, engine=Inline())
    for k, row in enumerate(rows):
        model = sweep_models.bar(cells=row["cells"]).finalize(device="cpu")
        model.set_parameter("bar.E", row["bar.E"])
        model.set_gravity((0, 0, row["gravity.z"]))
        sim = wf.Simulation(model, dt=5e-3, integrator="bdf2")
        sim.run(t_end=0.03)
        u = sim.probe("tip").displacement[0]
        assert result["tip"][k] == u[-1, 2]
        assert result["sag"][k] == np.linalg.norm(u, axis=1).max()
        assert result["stress"][k] == sim.field("von_mises", model.bodies[0]).max()
        assert result["e"][k] == sim.energies()["strain"][0]
        assert (result.series(k)["z"] == u[:, 2]).all()
        assert (result.series(k)["time"] == sim.probe("tip").time).all()
    assert result.best("tip")["design"] == int(result["tip"].argmin())


@pytest.mark.parametrize("worlds", [1, 7, 64])
def test_bits_do_not_depend_on_the_batch(worlds, pool):
    """In another process, against one batch of 64 here; the modulus also as an argument of the scene."""
    count = {1: 6, 7: 64, 64: 64}[worlds]
    here = wf.sweep(BAR, [{"bar.E": E} for E in STIFF], measures=TIP, run=SHORT, engine=Inline(1))
    for name in ("bar.E", "E") if worlds == 1 else ("bar.E",):
        rows = [{name: E} for E in STIFF[:count]]
        there = wf.sweep(BAR, rows, measures=TIP, run=SHORT, worlds=worlds, engine=pool)
        for measure in TIP:
            assert (there[measure] == here[measure][:count]).all()
    sizes = np.loadtxt(there.folder / "times.csv", delimiter=",", skiprows=1, usecols=2)
    assert sizes.max() == worlds


def test_initial_velocity_and_statics():
    rows = [{"velocity.stone.x": v, "gravity": (0.0, 0.0, -g)} for v, g in ((1.0, 1.0), (2.0, 3.0))]
    measures = {"x": "probe.p.displacement.x", "z": "probe.p.displacement.z"}
    result = wf.sweep(FALL, rows, measures=measures, run={"device": "cpu"}, engine=Inline())
    assert result["x"] == pytest.approx([0.03, 0.06], rel=1e-12)
    assert result["z"] == pytest.approx([-6e-4, -18e-4], rel=1e-9)
    run = {"static": True, "load_steps": 1, "device": "cpu"}
    result = wf.sweep(BAR, [{"bar.E": 1e9}, {"bar.E": 1e10}], measures=TIP, run=run, engine=Inline())
    assert result["tip"][0] == pytest.approx(10.0 * result["tip"][1], rel=0.02)


# failures


def test_failures_are_listed(tmp_path):
    """A design that can't be built, one without memory, one whose steps are refused, in a batch and alone."""
    rows = [{"trouble": name, "bar.E": E} for name in ("", "raise", "memory") for E in (1e5, 1e6)]
    result = wf.sweep(BAR, rows, measures=TIP, run=SHORT, engine=Inline(), out=tmp_path)
    assert set(result.failures) == {2, 3, 4, 5}
    assert "ModelError: scene 'bar': RuntimeError: no such bar" in result.failures[2]
    assert "MemoryError: Unable to allocate 8.00 GiB" in result.failures[4]
    assert np.isnan(result["tip"][2:]).all()
    assert table(result).count("failed") == 4


def test_a_world_that_fails_is_run_again_alone():
    """A stone that is torn out of its clamp fails alone, too; the measure that raises tells its worlds apart."""
    rows = [{"bar.E": E, "gravity.z": g} for E, g in ((1e5, -10.0), (1e5, -1e9), (1e5, -9.0))]
    result = wf.sweep(BAR, rows, measures=TIP, run=SHORT, engine=Inline(1))
    assert set(result.failures) == {1}
    assert result.failures[1].startswith("ConvergenceError")
    told = (result.folder / "times.csv").read_text().splitlines()
    assert [line.split(",")[3] for line in told] == ["alone", "", "failed", ""]
    picky = {"z": sweep_models.picky}
    result = wf.sweep(BAR, [{"bar.E": E} for E in (1e5, 1e8, 2e5)], measures=picky, run=SHORT, engine=Inline(1))
    assert list(result.failures) == [1]
    assert "measure 'picky': ValueError: too stiff" in result.failures[1]


class Deadly(Inline):
    """Its workers die of one design."""

    def result(self, handle):
        if 5 in handle.args[2] and handle.func.__name__ == "solve":
            raise WorkerLost("of design 5")
        return handle()


def test_a_deadly_design_is_found_in_its_batch():
    """Batches of eight are halved: the others of the batch have their results."""
    rows = [{"gravity.z": -1.0 * k} for k in range(16)]
    result = wf.sweep(FALL, rows, measures={"z": "probe.p.displacement.z"}, engine=Deadly(1), worlds=8)
    assert result.failures == {5: "its worker died 3 times"}
    assert result.retries == 3 + 3
    assert result["z"][6] == pytest.approx(-36e-4, rel=1e-9)


@pytest.mark.slow
def test_a_design_that_kills_its_worker_is_left(pool, tmp_path):
    """Its worker is replaced each time, and the others have their results."""
    rows = [{"trouble": "kill" if k == 0 else "", "bar.E": 1e5 + k} for k in range(4)]
    result = wf.sweep(BAR, rows, measures=TIP, run=SHORT, engine=pool, out=tmp_path)
    assert result.failures == {0: "its worker died 3 times"}
    assert result.retries == 3
    assert "killed" in table(result)


@pytest.mark.parametrize("known", [True, False])
def test_batches_are_as_large_as_memory_allows(monkeypatch, known):
    """Three worlds fit: the size is that of the error, or a half where it has none."""
    sizes, batch = [], Group.batch

    def limited(self, designs, columns):
        sizes.append(len(designs))
        if len(designs) > 3:
            raise wf.CapacityError("no room", worlds=3 if known else 0)
        return batch(self, designs, columns)

    monkeypatch.setattr(Group, "batch", limited)
    rows = [{"gravity.z": -1.0 * k} for k in range(10)]
    result = wf.sweep(FALL, rows, measures={"z": "probe.p.displacement.z"}, engine=Inline(1))
    assert result["z"] == pytest.approx(-6e-4 * np.arange(10), rel=1e-9)
    assert sizes == ([10, 3, 3, 3, 1] if known else [10, 5, 2, 2, 1, 5, 2, 2, 1])


@pytest.mark.cuda
def test_two_workers_of_one_gpu_give_the_bits_of_one():
    """Each sees a GPU of its own, as two GPUs would be dealt out."""
    rows = [{"cells": cells, "bar.E": E} for cells in (2, 3) for E in STIFF[:32].tolist()]
    tables, how = [], {"measures": TIP, "run": {"t_end": 0.03, "device": "cuda"}}
    for gpus, worlds in (([0], 64), ([0, 0], 7)):
        engine = PoolEngine(gpus=gpus)
        try:
            result = wf.sweep(BAR, rows, worlds=worlds, engine=engine, **how)
        finally:
            engine.close()
        assert not result.failures
        tables.append(table(result))
    assert tables[0] == tables[1]


def test_a_lost_batch_is_halved(tmp_path):
    """Workers die by chance; the table is that of an undisturbed sweep."""
    design = {"over": {"size": [1.0, 2.0], "gravity.z": [-0.1 * k for k in range(1, 17)]}}
    measures = {"z": "probe.p.displacement.z"}
    calm = wf.sweep(FALL, design, measures=measures, engine=Inline(), run={"device": "cpu"})
    wild = wf.sweep(FALL, design, measures=measures, engine=Inline(seed=1, deaths=0.3), run={"device": "cpu"})
    assert wild.retries > 0
    assert table(wild) == table(calm)


def test_memory_of_workers_is_limited():
    engine = PoolEngine(1, memory=16e9)
    try:
        limit = engine.result(engine.submit(sweep_models.resource.getrlimit, sweep_models.resource.RLIMIT_AS))
    finally:
        engine.close()
    assert limit == (16 * 10**9,) * 2


# the record


@pytest.fixture
def swept(tmp_path):
    """Folder and arguments of a finished sweep of eight designs."""
    how = {"measures": {"z": "probe.p.displacement.z"}, "run": {"device": "cpu"}, "engine": Inline(), "out": tmp_path}
    wf.sweep(FALL, DESIGN, worlds=2, **how)
    return tmp_path, how


DESIGN = {"over": {"size": [1.0, 2.0], "gravity.z": [-1.0, -2.0, -3.0, -4.0]}}


def test_a_torn_record_goes_on(swept):
    folder, how = swept
    path, before = folder / "record.jsonl", (folder / "table.csv").read_bytes()
    whole = path.read_bytes()
    lines = whole.splitlines(keepends=True)
    for cut in (len(whole) - 1, len(whole) - 30, len(b"".join(lines[:4])), len(lines[0]) + 3, 5, 0):
        path.write_bytes(whole[:cut])
        (folder / "table.csv").unlink()
        wf.sweep(FALL, DESIGN, **how, resume=True)
        assert (folder / "table.csv").read_bytes() == before
        assert sum("design" in json.loads(line) for line in path.read_text().splitlines()) == 8


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b'"values": {"z": -', b'"values": {"z": ', r"record.jsonl: line \d+ is damaged; restore the file"),
        (b'{"design": 1', b'{"design": 3', r"record.jsonl: line \d+ is damaged"),
    ],
)
def test_a_poisoned_record_is_refused(swept, old, new, message):
    folder, how = swept
    path = folder / "record.jsonl"
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    with pytest.raises(wf.CheckpointError, match=message):
        wf.sweep(FALL, DESIGN, **how, resume=True)


def test_other_lines_of_a_record_are_refused(swept):
    folder, how = swept
    path = folder / "record.jsonl"
    whole = path.read_bytes()
    path.write_bytes(whole + whole.splitlines(keepends=True)[2] * 2)
    with pytest.raises(wf.CheckpointError, match="line 12 repeats design 2"):
        wf.sweep(FALL, DESIGN, **how, resume=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"run": {"device": "cpu", "dt": 0.02}}, r"is of another sweep: run was \{'device': 'cpu'\}, is"),
        ({"measures": {"z": "probe.p.displacement.x"}}, "is of another sweep: measures was"),
        ({"parameters": {}, "design": {"over": {"size": [1.0, 2.5], **DESIGN["over"]}}}, "another sweep: design"),
        ({"resume": False}, "is there; go on with it"),
    ],
)
def test_foreign_records_are_refused(swept, change, message):
    _, how = swept
    given = {"design": DESIGN, "resume": True, **how, **change}
    if "design" in change:
        given["design"] = {"over": {"size": [1.0, 2.5], "gravity.z": DESIGN["over"]["gravity.z"]}}
    with pytest.raises(wf.CheckpointError, match=message):
        wf.sweep(FALL, **given)


def test_a_refused_sweep_leaves_no_record(tmp_path):
    how = {"run": {"device": "cpu"}, "engine": Inline(), "out": tmp_path}
    with pytest.raises(wf.ModelError, match=r"measures.z: probe 'q' is unknown"):
        wf.sweep(FALL, DESIGN, measures={"z": "probe.q.displacement.z"}, **how)
    assert len(wf.sweep(FALL, DESIGN, measures={"z": "probe.p.displacement.z"}, **how)) == 8


def test_two_drivers_of_one_record(swept):
    fcntl = pytest.importorskip("fcntl")
    folder, how = swept
    with open(folder / "record.jsonl", "ab") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(wf.CheckpointError, match="another sweep is writing it"):
            wf.sweep(FALL, DESIGN, **how, resume=True)


def test_another_plan_is_refused(swept):
    """Workers whose device chooses another solver would change bits."""
    folder, how = swept
    path = folder / "record.jsonl"
    from warpfea.sweeps.record import _decode, _encode

    lines = [_decode(line) for line in path.read_bytes().splitlines(keepends=True)]
    lines[1]["plan"]["preconditioner"] = "two-level"
    path.write_bytes(b"".join(_encode(json.dumps(line)) for line in lines[:4]))
    with pytest.raises(wf.CheckpointError, match=r"takes .*'banded'.*others took .*'two-level'"):
        wf.sweep(FALL, DESIGN, **how, resume=True)


# names


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"design": {"over": {"bar.EE": [1.0]}}}, "bar.EE"),
        ({"design": {"over": {"cels": [1]}}}, r"design.over.cels is unknown.*did you mean 'cells'"),
        ({"design": {"over": {"cells": []}}}, r"design.over.cells = \[\] must be a list of values"),
        ({"design": {"kind": "lhs", "over": {"E": (2.0, 1.0)}, "count": 3}}, "design.over.E is empty: low = 2.0"),
        ({"design": {"kind": "soboll", "over": {}}}, "design.kind = 'soboll' is none of.*did you mean 'sobol'"),
        ({"design": {"kind": "sobol", "over": {"E": (1.0, 2.0)}}}, "design.count = 0 must be a whole number"),
        ({"measures": {"z": "probe.tipp.displacement.z"}}, "measures.z: probe 'tipp' is unknown.*'tip'"),
        ({"measures": {"z": "probe.tip.displacement"}}, "measures.z: the component = '' is none of"),
        ({"measures": {"z": "most probe.tip.displacement.z"}}, "measures.z: the reduction = 'most'"),
        ({"measures": {"z": "field.mises"}}, "measures.z: field 'mises' is unknown"),
        ({"measures": {"z": "energy.strian"}}, "measures.z: energy 'strian' is unknown.*did you mean 'strain'"),
        ({"measures": {}}, "measures: give at least one"),
        ({"measures": {"cells": "energy.strain"}, "design": {"over": {"cells": [1]}}}, "a column 'cells' already"),
        ({"measures": {"z": lambda sim: 0.0}}, "measures.z: .*<lambda>.* is not at the top of the file"),
        ({"series": {"s": "field.von_mises"}}, "series.s: the kind = 'field'"),
        ({"run": {"dtt": 1.0}}, "run.dtt is unknown.*did you mean 'dt'"),
        ({"run": {"dt": -1.0}}, "dt = -1.0 must be a positive"),
        ({"run": {"integrator": "bdf3"}}, "bdf3"),
        ({"run": {"static": True, "dt": 1.0}}, "run.dt is unknown"),
        ({"parameters": {"Q": 1}}, "parameters.Q is unknown"),
        ({"parameters": {"cells": 1}, "design": {"over": {"cells": [1]}}}, "parameters.cells is a parameter of the"),
        ({"engine": 0}, "engine = 0 must be a number of workers"),
        ({"series": {"time": "probe.tip.displacement.z"}}, "series.time: the name 'time' is taken"),
        ({"design": {"over": {"E": {"low": 1, "high": 2, "count": 2, "whole": True}}}}, "design.over.E.whole is for"),
        ({"design": [{"bar.E": float("nan")}]}, "design: nan must be finite"),
        ({"worlds": 0}, "worlds = 0 must be a positive whole number"),
    ],
)
def test_errors_name_the_key(change, message):
    how = {"design": {"over": {"bar.E": [1e5]}}, "measures": TIP, "engine": Inline(), **change}
    with pytest.raises(wf.ModelError, match=message):
        wf.sweep(BAR, **how)


def test_functions_of_a_notebook_are_refused_by_name(tmp_path):
    file = tmp_path / "cell.py"
    text = "import warpfea as wf\n@wf.scene(dt=1.0, t_end=1.0)\ndef swing(): ...\ndef mine(sim): ...\n"
    file.write_text(text)
    found = runpy.run_path(str(file), run_name="notebook")  # of no module that a worker could import
    with pytest.raises(wf.ModelError, match="scene: 'swing' is defined in a notebook or at a prompt"):
        wf.sweep(found["swing"], [{"x": 1}], measures=TIP)
    with pytest.raises(wf.ModelError, match=r"measures.z: 'mine' is defined in a notebook"):
        parse_measure("measures.z", found["mine"])


def test_a_script_without_a_main_guard_is_told(tmp_path):
    file = tmp_path / "bare.py"
    file.write_text(f"import warpfea as wf\nwf.sweep({FALL!r}, [{{'size': 1.0}}], measures={{'e': 'energy.strain'}}, "
                    "run={'device': 'cpu'}, engine=1)\n")  # fmt: skip
    told = subprocess.run([sys.executable, str(file)], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert told.returncode == 1
    assert 'if __name__ == "__main__"' in told.stderr.splitlines()[-1]


# fits


def test_fit_finds_a_modulus():
    """All methods, from a record of the scene itself."""
    model = sweep_models.bar(E=3e5).finalize(device="cpu")
    sim = wf.Simulation(model, dt=5e-3, integrator="bdf2")
    sim.run(t_end=0.05)
    z = sim.probe("tip").displacement[0, 1::2, 2]
    record = {"probe.tip.displacement.z": (0.01 * np.arange(1, 6), z)}
    ranges = {"bar.E": {"low": 1e5, "high": 1e6, "log": True}}
    local = wf.fit(sweep_models.bar, ranges, record, method="least_squares", run={"device": "cpu"})
    assert local.values["bar.E"] == pytest.approx(3e5, rel=1e-6)
    led = wf.fit(sweep_models.bar, ranges, record, method="L-BFGS-B", run={"device": "cpu"})
    assert led.values["bar.E"] == pytest.approx(3e5, rel=1e-6)
    assert led.runs == led.backward_runs < 15
    assert 0 < local.backward_runs < 8
    with pytest.raises(wf.ModelError, match="'E' is a parameter of the scene"):
        wf.fit(sweep_models.bar, {"E": (1e5, 1e6)}, record, method="L-BFGS-B", run={"device": "cpu"})
    search = wf.fit(sweep_models.bar, ranges, record, worlds=16, generations=4, run={"device": "cpu"})
    assert search.values["bar.E"] == pytest.approx(3e5, rel=0.05)
    assert search.runs == 64
    built = wf.fit(sweep_models.bar, {"E": (1e5, 1e6)}, record, method="least_squares", run={"device": "cpu"})
    assert built.values["E"] == pytest.approx(3e5, rel=1e-6)
    assert built.backward_runs == 0  # differences
    with pytest.raises(wf.ModelError, match="needs as many times as values, at ends of steps"):
        wf.fit(BAR, ranges, {"probe.tip.displacement.z": ([0.0123], [0.0])}, worlds=2, generations=1)


def test_pareto_and_pictures(tmp_path):
    rows = [{"bar.E": E, "cells": cells} for E in (1e5, 1e6) for cells in (1, 2)]
    result = wf.sweep(BAR, rows, measures=TIP, run={"t_end": 0.01, "device": "cpu"}, engine=Inline(), out=tmp_path)
    front = result.pareto("tip", "stress")
    x, y = result["tip"], result["stress"]
    beaten = [any((x[j] < x[k] and y[j] <= y[k]) or (x[j] <= x[k] and y[j] < y[k]) for j in range(4)) for k in range(4)]
    assert sorted(front) == [k for k in range(4) if not beaten[k]]
    result.plot(tmp_path / "table.png")
    result.plot(tmp_path / "front.png", pareto=("tip", "stress"))
    result.sheet(tmp_path / "sheet.png", [0, 3], field="von_mises")
    assert all((tmp_path / f"{name}.png").stat().st_size > 1000 for name in ("table", "front", "sheet"))
    with pytest.raises(wf.ModelError, match=r"sheet: designs = \[9\]"):
        result.sheet(tmp_path / "sheet.png", [9])
