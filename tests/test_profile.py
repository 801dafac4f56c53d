"""warpfea profile: what is measured, what the labels say, the command's files and errors."""

import contextlib
import json
import sys
import types

import numpy as np
import pytest
import warp as wp
from warpfea.kernels.common.state import state_kernels

import warpfea as wf
from warpfea.base.launch import LAUNCH_PARTS, Launcher, launch_part
from warpfea.builder.scene import find
from warpfea.cli import main
from warpfea.cli.profile import JSON_KEYS
from warpfea.studies.profile import profiling
from warpfea.studies.profile.profiling import LaunchRecorder, launch_bytes, profile
from warpfea.terms.term_set import profile_parts

WORDS = ["profile", "cantilever", "--set", "cells=2", "--device", "cpu", "--steps", "2"]


TICK = 1e-3


class Ticks:
    """A clock that goes on by a millisecond at each reading: times are counts, whatever else the machine does."""

    def __init__(self):
        self.readings = 0

    def perf_counter(self):
        self.readings += 1
        return TICK * self.readings


@pytest.fixture(autouse=True)
def counting(monkeypatch, request):
    """Small copies, and the clock of the profile replaced, but for CUDA, whose times come from events."""
    monkeypatch.setitem(profiling.COPY_BYTES, "cpu", 2**22)
    if "cuda" not in request.keywords:
        monkeypatch.setattr(profiling, "clock", Ticks())


def simulation(name, device, **values):
    scene = find(name)
    model = scene.build(scene.resolve(values)).finalize(device=device)
    return wf.Simulation(model, dt=scene.dt, integrator=scene.integrator)


def launches_of(name, device, steps, after, **values):
    """Launches of the steps that follow `after` steps, counted without a graph and without a profile."""
    scene = find(name)
    model = scene.build(scene.resolve(values)).finalize(device=device)
    sim = wf.Simulation(model, dt=scene.dt, integrator=scene.integrator, capture=False)
    sim.step(after)
    before = sim.stepper.launch.launches
    sim.step(steps)
    return sim.stepper.launch.launches - before


def check(found, steps):
    """Properties of any profile."""
    assert len(found.step_ms) == steps
    own = [name for name in LAUNCH_PARTS if name in found.parts]
    assert list(found.parts)[: len(own)] == own
    assert set(found.parts) <= set(profile_parts())
    assert {"residual", "product", "preconditioner", "build", "vectors", "control", "commit"} <= set(found.parts)
    for key in ("ms", "launches", "bytes"):
        assert sum(getattr(p, key) for p in found.parts.values()) == pytest.approx(
            sum(getattr(k, key) for k in found.kernels)
        )
    assert found.kernels_ms + found.between_ms == pytest.approx(found.total_ms)
    assert found.total_ms >= 0.999 * np.mean(found.step_ms)  # by definition of what lies between
    assert found.launches > found.pcg >= found.newton >= 1.0
    assert found.parts["product"].launches >= found.pcg
    assert found.copy_GBps > 0.0
    assert found.empty_launch_us > 0.0
    assert [k.ms for k in found.kernels] == sorted((k.ms for k in found.kernels), reverse=True)


# what is measured


def test_profile_adds_up_and_leaves_the_run_as_it_was(device):
    sim, plain = simulation("cantilever", device, cells=2), simulation("cantilever", device, cells=2)
    calls = []
    recorded = sim.stepper.launch.launches
    found = profile(sim, steps=2, on_step=lambda: calls.append(1))
    check(found, 2)
    assert 2 * found.launches == launches_of("cantilever", device, 2, profiling.WARM_UP_STEPS, cells=2)
    assert len(calls) == profiling.WARM_UP_STEPS + 2 + 1 + 2
    assert "loads" in found.parts  # gravity
    assert "constraints" not in found.parts
    plain.step(profiling.WARM_UP_STEPS + 2)
    assert sim.steps == plain.steps
    for name, values in plain.state.numpy().items():
        assert np.array_equal(sim.state.numpy()[name], values), name
    assert sim.stepper.launch.recorder is None
    assert sim.stepper.launch.launches == recorded
    assert np.array_equal(sim.step().pcg, plain.step().pcg)


def test_each_launch_takes_its_time_less_that_of_an_empty_one(device, monkeypatch):
    """With a clock that counts, a launch is one reading long, a step is one, and an empty launch is one."""
    assert profiling._empty_launch_seconds(device) == pytest.approx(TICK)
    monkeypatch.setattr(profiling, "_empty_launch_seconds", lambda device: 0.25 * TICK)
    found = profile(simulation("cantilever", device, cells=2), steps=2)
    assert found.step_ms == pytest.approx([1.0, 1.0])
    assert found.empty_launch_us == pytest.approx(250.0)
    assert found.copy_GBps == pytest.approx(2e-9 * 2**22 / TICK)
    for k in found.kernels:
        assert k.ms == pytest.approx(0.75 * k.launches)
    assert found.kernels_ms == pytest.approx(0.75 * found.launches)
    assert found.between_ms == 0.0
    few = profiling.Profile((400.0, 600.0), found.kernels[:1], 1.0, 1.0, 1.0, 1.0)
    assert few.between_ms == pytest.approx(500.0 - few.kernels_ms)


def test_joints_are_a_part(device):
    found = profile(simulation("double_pendulum", device), steps=1)
    check(found, 1)
    names = {k.kernel.rpartition(".")[2] for k in found.kernels if k.part == "constraints"}
    assert "evaluate" in names


def test_nothing_is_without_a_part_but_control(device):
    found = profile(simulation("cantilever", device, cells=2), steps=1)
    control = {k.kernel.rpartition(".")[2] for k in found.kernels if k.part == "control"}
    assert not control & {
        "internal_force",
        "tangent_product",
        "residual",
        "operator_product",
        "gather_diagonal_blocks",
        "final_sums",
    }


@pytest.mark.cuda
def test_profile_on_cuda():
    found = profile(simulation("cantilever", "cuda:0"), steps=2)
    check(found, 2)
    assert all(k.launches > 0 for k in found.kernels)
    assert found.kernels_ms > 0.0


def test_bad_options_are_named(device):
    sim = simulation("cantilever", device, cells=2)
    with pytest.raises(wf.ModelError, match="steps = 0"):
        profile(sim, steps=0)
    sim.stepper.graph = None
    with pytest.raises(wf.ModelError, match="capture=False"):
        profile(sim)


# labels, bytes, times of a GPU


def test_the_innermost_label_counts_and_ends_with_its_block(device):
    launch, seen = Launcher(device), []
    launch.recorder = lambda part, *_: seen.append(part)
    flags = wp.zeros(1, dtype=wp.int32, device=device)
    rows = wp.zeros((1, 1), dtype=wp.uint32, device=device)

    class Owner:
        def __init__(self):
            self.launch = launch

        @launch_part("loads")
        def do(self, *, fail=False):
            """A step of its own."""
            launch(state_kernels().copy_rows, (1, 1), [flags, rows, rows])
            if fail:
                raise ValueError

    owner = Owner()
    assert owner.do.__doc__ == "A step of its own."
    with launch.part("commit"):
        owner.do()
        launch(state_kernels().copy_rows, (1, 1), [flags, rows, rows])
        launch(state_kernels().copy_rows, (1, 0), [flags, rows, rows])  # empty
    with contextlib.suppress(ValueError):
        owner.do(fail=True)
    launch(state_kernels().copy_rows, (1, 1), [flags, rows, rows])
    assert seen == ["loads", "commit", "loads", "control"]
    assert launch.launches == 0


@wp.struct
class Pair:
    a: wp.array(dtype=wp.float64)
    b: wp.array(dtype=wp.vec3d)
    n: wp.int32


def test_bytes_count_each_array_once(device):
    a, b = wp.zeros(10, dtype=wp.float64, device=device), wp.zeros(4, dtype=wp.vec3d, device=device)
    pair = Pair()
    pair.a, pair.b = a, b
    assert launch_bytes([a, a, 3, None]) == 80
    assert launch_bytes([pair, a, a[:5]]) == 80 + 96
    assert launch_bytes([pair], {"b", "x"}) == 96
    repeated = wp.array(ptr=a.ptr, dtype=wp.float64, shape=(7, 10), strides=(0, 8), device=device)
    assert launch_bytes([repeated]) == 80


def test_times_of_a_gpu_are_booked_in_order():
    recorder = LaunchRecorder("cpu")
    recorder.device = types.SimpleNamespace(is_cuda=True)
    kernel, flags = state_kernels().copy_rows, wp.zeros(2, dtype=wp.int32, device="cpu")
    made = []

    def make():
        made.append(1)
        return types.SimpleNamespace(launch=lambda: None)

    for name in ("product", "loads", "product"):
        recorder(name, kernel, (1, 1), [flags], make)
    recorder.book_times([1.0, 5.0, 2.0])
    assert len(made) == 2  # a command that comes again is kept
    rows = recorder.kernels(2, 0.5e-3)
    assert [(r.part, r.launches, r.bytes) for r in rows] == [("loads", 0.5, 4.0), ("product", 1.0, 8.0)]
    assert [r.ms for r in rows] == pytest.approx([2.25, 1.0])
    assert rows[0].GBps == pytest.approx(4.0 / 2.25e-3 * 1e-9)
    recorder(name, kernel, (1, 1), [flags], make)
    with pytest.raises(wf.ModelError, match="2 kernels were timed and 1 launched"):
        recorder.book_times([1.0, 1.0])


# the command


def test_command_writes_tables_json_and_picture(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    png, file = tmp_path / "p.png", tmp_path / "p.json"
    assert main([*WORDS, "--png", str(png), "--json", str(file)]) == 0
    printed, progress = capsys.readouterr()
    assert not progress  # stderr is no terminal
    content = json.loads(file.read_text())
    assert tuple(content) == JSON_KEYS
    assert content["steps"] == 2
    assert content["parameters"]["cells"] == 2
    assert content["step_ms"]["min"] <= content["step_ms"]["median"] <= content["step_ms"]["max"]
    shares = sum(p["share"] for p in content["parts"].values())
    assert shares + content["between_ms"] / (content["kernels_ms"] + content["between_ms"]) == pytest.approx(1.0)
    assert sum(k["launches"] for k in content["kernels"]) == pytest.approx(content["launches_per_step"])
    assert png.read_bytes().startswith(b"\x89PNG")
    for text in (*content["parts"], "between", "GB/s", "of copy", "PCG", content["kernels"][0]["kernel"], str(png)):
        assert text in printed


def test_json_on_stdout_stands_alone_and_a_mesh_can_be_profiled(tmp_path, capsys):
    mesh = tmp_path / "bar.inp"
    mesh.write_text(
        "*NODE\n1,0,0,0\n2,1,0,0\n3,0,1,0\n4,0,0,1\n*ELEMENT,TYPE=C3D4,ELSET=bar\n1,1,2,3,4\n*NSET,NSET=base\n1,3,4\n"
    )
    words = ["--material", "svk:E=1e6,nu=0.3,density=1000", "--clamp", "base", "--device", "cpu", "--steps", "1"]
    assert main(["profile", str(mesh), *words, "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["elements"] == 1


@pytest.mark.parametrize(
    ("words", "code", "named"),
    [
        (["profile", "no_scene"], 2, "no_scene"),
        ([*WORDS, "--set", "cellz=2"], 2, "cellz"),
        ([*WORDS, "--steps", "0"], 2, "--steps"),
        ([*WORDS, "--png", "p.jpg"], 2, "p.jpg"),
        ([*WORDS, "--png", "no/folder/p.png"], 4, "no/folder"),
        ([*WORDS, "--json", "no/folder/p.json"], 4, "no/folder"),
    ],
)
def test_bad_usage_is_one_line(words, code, named, capsys):
    assert main(words) == code
    printed, err = capsys.readouterr()
    assert not printed
    assert named in err
    assert err.count("\n") == 1


def test_the_picture_needs_matplotlib(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert main([*WORDS, "--png", str(tmp_path / "p.png")]) == 4
    assert "warpfea[plots]" in capsys.readouterr().err
