"""Sweeps in TOML and their command; a record after kills, with each engine."""

import contextlib
import os
import random
import re
import signal
import subprocess
import sys
import time
from operator import truediv

import numpy as np
import pytest
from test_sweep import BAR, FALL, MODELS, TIP, Inline, table

import warpfea as wf
from warpfea.cli import main
from warpfea.sweeps import DaskEngine, read_study, run_study

STUDY = f"""
scene = "{BAR}"
[parameters]
E = 3e5
[design]
kind = "grid"
[design.over]
cells = [1, 2]
gravity.z = {{low = -10.0, high = -5.0, count = 3}}
[measures]
tip = "min probe.tip.displacement.z"
own = "measures.py:half"
[run]
t_end = 0.02
device = "cpu"
"""


@pytest.fixture
def study(tmp_path):
    """A study file with a measure beside it."""
    (tmp_path / "measures.py").write_text("def half(sim):\n    return 0.5 * sim.probe('tip').displacement[:, -1, 2]\n")
    path = tmp_path / "study.toml"
    path.write_text(STUDY)
    return path


def test_a_study_is_the_sweep_that_it_describes(study, tmp_path):
    read = read_study(study)
    assert read["design"].columns["gravity.z"] == [-10.0, -7.5, -5.0] * 2
    assert read["out"] == tmp_path / "sweep"
    result = run_study(study, out=tmp_path / "out")
    rows = [{"cells": cells, "gravity.z": g} for cells in (1, 2) for g in (-10.0, -7.5, -5.0)]
    how = {"parameters": {"E": 3e5}, "run": {"t_end": 0.02, "device": "cpu"}, "engine": Inline()}
    same = wf.sweep(BAR, rows, measures={"tip": "min probe.tip.displacement.z"}, **how)
    assert (result["tip"] == same["tip"]).all()
    assert (result["own"] == 0.5 * result["tip"]).all()


def test_the_command(study, tmp_path, capfd):
    study.write_text(STUDY.replace("t_end = 0.02", "t_end = 0.01") + '[engine]\nworkers = 1\nworlds = 2\n'
                     '[pictures]\ntable = "t.png"\nsheet = "s.png"\ndesigns = [1, 4]\n')  # fmt: skip
    assert main(["sweep", str(study)]) == 0
    shown, told = capfd.readouterr()
    assert told == ""
    assert "designs  6, 0 failed, 0 tasks lost" in shown
    folder = tmp_path / "sweep"
    for name in ("record.jsonl", "table.csv", "times.csv", "t.png", "s.png"):
        assert (folder / name).stat().st_size > 0
    before = (folder / "table.csv").read_bytes()
    assert main(["sweep", str(study)]) == 2
    assert "record.jsonl: is there; go on with it (resume=True, --resume)" in capfd.readouterr()[1]
    assert main(["sweep", str(study), "--resume", "--quiet"]) == 0
    assert capfd.readouterr() == ("", "")
    assert (folder / "table.csv").read_bytes() == before
    assert main(["sweep", "--help"]) == 0
    assert "--scheduler" in capfd.readouterr()[0]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[run]", "[runn]", "runn is unknown; there are .*did you mean 'run'"),
        ("t_end", "tend", "run.tend is unknown; .*did you mean 't_end'"),
        ("E = 3e5", "EE = 3e5", "parameters.EE is unknown"),
        ("cells = [1, 2]", "cells = []", r"design.over.cells = \[\] must be a list of values that is not empty"),
        ("count = 3", "cuont = 3", "design.over.gravity.z.cuont is unknown; .*did you mean 'count'"),
        ("low = -10.0", "low = -1.0", "design.over.gravity.z is empty: low = -1.0 is not below high = -5.0"),
        ("low = -10.0", 'low = "a"', "design.over.gravity.z.low = 'a' must be a finite number"),
        ('kind = "grid"', 'kind = "girdle"', "design.kind = 'girdle' is none of"),
        ('kind = "grid"', 'kind = "grid"\nseed = 1', "design.seed is unknown; there are over"),
        ("scene = ", "scnee = ", "scnee is unknown; .*did you mean 'scene'"),
        ("min probe.tip", "min prob.tip", "measures.tip: the kind = 'prob' is none of .*did you mean 'probe'"),
        ('"measures.py:half"', "3", "measures.own = 3 must be a text"),
        ('device = "cpu"', "device = 3", "run.device = 3 must be a text"),
        ("[run]", "[engine]\nworkers = 1.5\n[run]", "engine.workers = 1.5 must be a whole number"),
        ("[run]", "[pictures]\ntable = 't.jpg'\n[run]", "pictures.table: the type = '.jpg' is none of"),
        ("[run]", "[pictures]\nsheet = 's.svg'\n[run]", "pictures.sheet: the type = '.svg' is none of '.png'"),
        ("[run]", "[pictures]\npareto = ['tip']\n[run]", r"pictures.pareto = \['tip'\] must be the names of two"),
        ("[run]", "[pictures]\npareto = ['tip', 'top']\n[run]", "pictures.pareto: the column = 'top' is none of"),
        ("[run]", "[pictures]\ndesigns = [0, 6]\n[run]", r"pictures.designs = \[0, 6\] must be numbers from 0 to 5"),
        ("[run]", "[pictures]\nfield = 'mises'\n[run]", "pictures.field = 'mises' is none of .*'von_mises'"),
        ("measures.py:half", "measure.py:half", "measure.py: no such file"),
        ("measures.py:half", "measures.py:halve", "function 'halve' is unknown"),
        ("[parameters]\nE = 3e5", "parameters = 3", "parameters = 3 must be a table"),
        ("[design]", "[design", "study.toml: .*at line"),
    ],
)
def test_errors_of_a_study_name_file_and_key(study, capfd, old, new, message):
    assert old in STUDY
    study.write_text(STUDY.replace(old, new, 1))
    with pytest.raises(wf.ModelError, match=rf"(?s)study.toml: .*{message}|{message}"):
        run_study(study)
    assert not (study.parent / "sweep" / "table.csv").exists()
    assert main(["sweep", str(study)]) == 2
    assert "study.toml: " in capfd.readouterr()[1]


def test_a_study_without_what_it_needs(study):
    study.write_text('scene = "cantilever"\n')
    with pytest.raises(wf.ModelError, match=r"study.toml: design is missing"):
        run_study(study)
    with pytest.raises(wf.ModelError, match=r"nothing.toml: can't be read"):
        run_study(study.with_name("nothing.toml"))


# engines


@pytest.fixture(scope="module")
def cluster():
    """Address of a scheduler with two workers of one thread, over tcp."""
    distributed = pytest.importorskip("distributed")
    options = {"n_workers": 2, "threads_per_worker": 1, "protocol": "tcp://", "dashboard_address": None}
    with distributed.LocalCluster(**options, silence_logs=50) as made:
        yield made.scheduler_address


@pytest.mark.slow
def test_a_cluster_gives_the_same_bits(cluster):
    rows = [{"bar.E": E, "cells": cells} for E in (1e5, 1e6) for cells in (1, 2)]
    how = {"measures": TIP, "run": {"t_end": 0.02, "device": "cpu"}}
    assert table(wf.sweep(BAR, rows, **how, engine=cluster)) == table(wf.sweep(BAR, rows, **how, engine=Inline()))


@pytest.mark.slow
def test_a_worker_with_an_error_of_its_machine_is_replaced(cluster):
    """As errors of CUDA stay with a process; those of warpfea are of a design."""
    engine = DaskEngine(cluster)
    try:
        pids = [engine.client.run(os.getpid)]
        for call, given, kind in ((truediv, (1, 0), ZeroDivisionError), (wf.SVK, (-1, 0), wf.ModelError)):
            handle = engine.submit(call, *given)
            (handle,) = engine.done([handle])
            with pytest.raises(kind):
                engine.result(handle)
            engine.client.wait_for_workers(2, timeout=60)
            pids.append(engine.client.run(os.getpid))
        first, second, third = (set(each.values()) for each in pids)
        assert len(first & second) == 1
        assert second == third
    finally:
        engine.close()


@pytest.mark.slow
def test_workers_of_several_threads_are_refused():
    distributed = pytest.importorskip("distributed")
    options = {"n_workers": 1, "threads_per_worker": 2, "processes": False, "dashboard_address": None}
    with (
        distributed.LocalCluster(**options, silence_logs=50) as made,
        pytest.raises(wf.ModelError, match="has 2 threads: start it with --nthreads 1"),
    ):
        DaskEngine(made.scheduler_address)


KILLED = f"""
scene = "{FALL}"
[design]
kind = "random"
count = 200
seed = 2
[design.over]
size = {{low = 1, high = 8, whole = true}}
gravity.z = {{low = -9.0, high = -1.0}}
velocity.stone.x = {{low = -1.0, high = 1.0}}
[measures]
z = "probe.p.displacement.z"
x = "probe.p.displacement.x"
slow = "{MODELS}:slow_fall"
[run]
device = "cpu"
[engine]
worlds = 4
"""


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["pool", "cluster"])
def test_the_table_after_kills_is_that_of_an_undisturbed_sweep(engine, tmp_path, request):
    """Driver and workers are killed after a seeded number of records, six times in all, and the sweep is resumed."""
    (tmp_path / "study.toml").write_text(KILLED)
    how = ["--scheduler", request.getfixturevalue("cluster")] if engine == "cluster" else ["--workers", "2"]
    words = [sys.executable, "-m", "warpfea", "sweep", str(tmp_path / "study.toml"), "--resume", *how]
    folder, chance = tmp_path / "sweep", random.Random(f"kills of {engine}")
    calm = run_study(tmp_path / "study.toml", out=tmp_path / "calm", workers=1)
    assert len(calm) == 200
    victims, killed = ["worker", "driver", "worker", "worker", "driver", "worker"], 0
    env = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    driver = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env)
    for victim in victims:
        wait_for_records(folder, chance.randint(8, 25), driver)
        pids = {int(line.split(",")[4].split(":")[1]) for line in lines_of(folder / "times.csv")[-2:]}
        pid = driver.pid if victim == "driver" else chance.choice(sorted(pids))
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
            killed += 1
        if victim == "driver":
            driver.wait()
            driver = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env)
    shown, told = driver.communicate(timeout=300)
    assert driver.returncode == 0, told
    assert killed >= 4
    for name in ("table.csv", *(["table.parquet"] if (folder / "table.parquet").exists() else [])):
        assert (folder / name).read_bytes() == (tmp_path / "calm" / name).read_bytes()
    assert "200, 0 failed" in shown
    indices = [line for line in lines_of(folder / "record.jsonl") if line.startswith('{"design"')]
    assert len(indices) == len(set(indices)) == 200  # nothing that was written is done again
    z = np.genfromtxt(folder / "table.csv", delimiter=",", skip_header=1, usecols=(2, 4))
    assert z[:, 1] == pytest.approx(6e-4 * z[:, 0], rel=1e-9)  # g h^2 n (n + 1) / 2


def lines_of(path):
    return path.read_text().splitlines()[path.name == "times.csv" :] if path.exists() else []


def wait_for_records(folder, count, driver):
    """Wait until so many more lines are recorded, or the driver ended."""
    before, deadline = len(lines_of(folder / "record.jsonl")), time.monotonic() + 200
    while len(lines_of(folder / "record.jsonl")) < before + count or not lines_of(folder / "times.csv"):
        if driver.poll() is not None:
            raise AssertionError(driver.communicate())
        assert time.monotonic() < deadline
        time.sleep(0.02)


COMPILES = """
import pathlib, sys, time
import warp as wp
from warpfea.base.launch import load_modules

@wp.kernel(module="compiled_once")
def double(x: wp.array(dtype=float)):
    x[wp.tid()] *= 2.0

wp.config.log_level = wp.LOG_INFO
wp.init()
here = pathlib.Path(sys.argv[0]).parent
(here / sys.argv[1]).touch()
while len(list(here.glob("ready*"))) < 2:
    time.sleep(0.001)
load_modules({"compiled_once": double.module}, "cpu", None)
"""


def test_one_of_two_processes_compiles(tmp_path):
    """Both ask for a kernel at the same time: one compiles it, the other waits and loads it."""
    (tmp_path / "compile.py").write_text(COMPILES)
    env = os.environ | {"WARP_CACHE_PATH": str(tmp_path / "cache"), "PYTHONPATH": os.pathsep.join(sys.path)}
    call = [sys.executable, str(tmp_path / "compile.py")]
    calls = [subprocess.Popen([*call, f"ready{k}"], stdout=subprocess.PIPE, text=True, env=env) for k in range(2)]
    shown = sorted(process.communicate()[0].split()[-1] for process in calls)
    assert shown == ["(cached)", "(compiled)"]


@pytest.mark.slow
def test_the_page_of_sweeps_runs(tmp_path):
    """Its script, as a user runs it, within a minute after compilation."""
    page = (MODELS.parent.parent / "warpfea" / "sweeps" / "SWEEPS.md").read_text()
    code = next(block for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "__main__" in block)
    (tmp_path / "stiffness.py").write_text(code)
    env = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "CUDA_VISIBLE_DEVICES": ""}
    call, took = [sys.executable, "stiffness.py"], []
    for name in ("first", "second"):
        began = time.monotonic()
        told = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True, check=False, env=env)
        took.append(time.monotonic() - began)
        assert told.returncode == 0, told.stderr
        assert "20 designs, 0 failed; the stiffest: {'design': " in told.stdout
        assert {path.name for path in (tmp_path / "stiffness").glob("*.png")} == {"table.png", "sheet.png"}
        (tmp_path / "stiffness").rename(tmp_path / name)
    assert took[1] < 60.0  # kernels are compiled
    first, second = ((tmp_path / name / "table.csv").read_bytes() for name in ("first", "second"))
    assert first == second


@pytest.mark.slow
def test_ctrl_c_leaves_a_record_that_goes_on(tmp_path):
    """The terminal interrupts driver and workers together: exit code 130, one line, no traceback."""
    (tmp_path / "study.toml").write_text(KILLED.replace("count = 200", "count = 40"))  # most are left then
    words = [sys.executable, "-m", "warpfea", "sweep", str(tmp_path / "study.toml"), "--resume", "--workers", "2"]
    env, folder = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}, tmp_path / "sweep"
    how = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "env": env, "start_new_session": True}
    driver = subprocess.Popen(words, **how)
    wait_for_records(folder, 5, driver)
    os.killpg(driver.pid, signal.SIGINT)
    shown, told = driver.communicate(timeout=60)
    assert (driver.returncode, shown) == (130, "")
    assert "interrupted" in told.splitlines()[-1]
    assert "Traceback" not in told
    assert len(run_study(tmp_path / "study.toml", resume=True, workers=1).failures) == 0
