"""Input of a new user: messages that say what to write, short reprs, the names of `warpfea`, devices, times told."""

from __future__ import annotations

import ast
import inspect
import pathlib
import subprocess
import sys
import types
import typing
from dataclasses import fields

import numpy as np
import pytest
import warp as wp

import warpfea as wf
from warpfea.base.worlds import worlds_mask
from warpfea.cli import main
from warpfea.simulation.reports import ContactRecord, JointRecord

ROOT = pathlib.Path(wf.__file__).parents[1]
LAW = wf.SVK(E=1e7, nu=0.3, density=1000.0)


def scene(*, material=LAW):
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    bar = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1)), material=material, name="bar")
    b.clamp(bar.nodes("x-"))
    b.add_probe("tip", bar.surface("x+"))
    return b, bar


@pytest.fixture(scope="module")
def sim():
    return wf.Simulation(scene()[0].finalize(device="cpu"), dt=2e-3)


# messages; each gave a TypeError, a ValueError or no word about what to write on 8934ce7

SIM = {
    "seconds": (lambda s: s.run("1 s"), r"t_end = '1 s' must be a finite time \(s\); write 1, a bare number in SI"),
    "milliseconds": (lambda s: s.run("5ms"), r"write 0\.005, a bare number"),
    "nothing": (lambda s: s.run(None), r"t_end = None must be a finite time \(s\)$"),
    "step": (lambda s: setattr(s, "dt", "2 ms"), r"dt = '2 ms' .*; write 0\.002"),
    "freeze": (lambda s: s.freeze([3]), r"freeze: worlds = \[3\] must be numbers from 0 to 0"),
    "field": (lambda s: s.field("mises", s.model.bodies[0]), "did you mean 'von_mises'"),
}


@pytest.mark.parametrize("case", SIM)
def test_a_simulation_says_what_to_write(sim, case):
    call, text = SIM[case]
    with pytest.raises(wf.ModelError, match=text):
        call(sim)
    assert sim.steps == 0


SAMPLED = r"is a Python function;.*do not run on the device: sample it, \(times, \[f\(t\) for t in times\]\).*@wp\.func"
BUILD = {
    "lambda": (
        lambda b, bar: b.add_traction(bar.surface("x+"), lambda t: (0, 0, t)),
        f"traction .*: a lambda {SAMPLED}",
    ),
    "function": (lambda b, bar: b.add_pressure(bar.surface("x+"), np.sin), f"pressure .*: sin {SAMPLED}"),
    "field": (
        lambda b, bar: b.add_body_force(lambda x, t: x),
        r"write def f\(x: wp\.vec3d, t: wp\.float64\) -> wp\.vec3d",
    ),
    "gravity": (
        lambda b, bar: wf.ModelBuilder(gravity=-9.81),
        r"gravity = -9\.81 .*; write a vector such as \(0, 0, -9\.81\)",
    ),
    "traction": (lambda b, bar: b.add_traction(bar.surface("x+"), 5.0), r"write a vector such as \(0, 0, 5\.0\)"),
    "newtons": (lambda b, bar: b.add_traction(bar.surface("x+"), "100 N"), "write 100, a bare number"),
    "name": (lambda b, bar: b.clamp("x-"), r"clamp: .*; write body\.nodes\('x-'\)"),
    "law as text": (lambda b, bar: scene(material="svk:E=1e7,nu=0.3"), r"material must be .*; write wf\.SVK\(E="),
    "law's class": (lambda b, bar: scene(material=wf.SVK), r"got <class .*; write wf\.SVK\(E="),
    "unit": (lambda b, bar: wf.SVK(E="210 GPa", nu=0.3), r"SVK: E = '210 GPa' .*; write 2\.1e\+11, a bare"),
    "text": (lambda b, bar: wf.SVK(E=1e7, nu="0.3"), r"nu = '0\.3' .*; write 0\.3"),
    "density": (lambda b, bar: wf.SVK(E=1e7, nu=0.3, density="7.85 g/cm^3"), r"density = .*; write 7850, a bare"),
    "rho": (lambda b, bar: wf.SVK(E=1e7, nu=0.3, rho=1000.0), "SVK: 'rho' is unknown; .*; did you mean 'density'"),
    "poisson": (lambda b, bar: wf.SVK(E=1e7, poisson=0.3), "did you mean 'nu'"),
    "in a row": (
        lambda b, bar: wf.SVK(1e7, 0.3, 1000.0),
        "SVK: 3 values without names, such as density=, are too many",
    ),
    "hinge": (
        lambda b, bar: b.add_joint("hinge", parent=wf.GROUND, child=bar.surface("x-"), axis=(0, 1, 0)),
        "kind 'hinge' is unknown; .*; did you mean 'revolute'",
    ),
}


@pytest.mark.parametrize("case", BUILD)
def test_a_builder_says_what_to_write(case):
    call, text = BUILD[case]
    with pytest.raises(wf.ModelError, match=text):
        call(*scene())


def test_a_generator_says_what_to_write():
    with pytest.raises(wf.MeshError, match=r"cells: expected 3 numbers, got 2; write \(2, 2, 2\)"):
        wf.mesh.box((1, 1, 1), cells=2)


def test_samples_in_square_brackets_are_samples():
    """Fails on 8934ce7: a list of times and values was refused."""
    values = [(0, 0, 0), (0, 0, 100)]
    u = []
    for law in (([0, 0.1], values), [[0, 0.1], values]):
        b, bar = scene()
        b.add_traction(bar.surface("x+"), law)
        sim = wf.Simulation(b.finalize(device="cpu"), dt=0.05)
        sim.run(0.1)
        u.append(sim.displacements(bar))
    assert np.array_equal(*u)


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (
            ["cantilever", "--t-end", "1s"],
            "argument --t-end: '1s' is not a positive finite number; write 1, a bare number",
        ),
        (["cantilever", "--set", "length=20 cm"], "of scene 'cantilever'; write 0.2, a bare number in SI units"),
        (
            ["part.msh", "--material", "svk:E=210GPa,nu=.3"],
            "E = '210GPa' is not a finite number; write 2.1e+11, a bare",
        ),
        (["part.msh", "--material", "svk:E=1e7;nu=.3"], "commas stand between the values"),
        (["part.msh", "--material", "steel"], "such as svk:E=2.1e11,nu=0.3,density=7850"),
        (["part.msh", "--material", "svk:E=1e7,nu=.3,rho=1"], "did you mean 'density'"),
    ],
)
def test_the_command_line_says_what_to_write(tmp_path, monkeypatch, capfd, words, text):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "part.msh").write_text("$MeshFormat\n2.2 0 8\n$EndMeshFormat\n")
    assert main(["run", *words]) == 2
    out, err = capfd.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert text in err


# worlds by number


@pytest.mark.parametrize(
    ("worlds", "mask", "chosen"),
    [
        (3, [0, 2], [0, 2]),
        (4, 2, [2]),
        (3, np.array([1], np.int32), [1]),
        (3, np.zeros(0, int), []),
        (5, np.arange(5), range(5)),
        (2, [True, False], [0]),
        (3, [1, 0, 0], [0]),  # flags: 0 is there twice
        (3, np.array([0, 1, 0]), [1]),
        (2, np.array([1, 1]), [0, 1]),
    ],
)
def test_worlds_by_flags_or_numbers(worlds, mask, chosen):
    assert np.flatnonzero(worlds_mask("reset", mask, worlds)).tolist() == list(chosen)


@pytest.mark.parametrize(
    ("worlds", "mask", "text"),
    [
        (2, [0, 1], r"is ambiguous \(flags or world indices\): write \[False, True\] or \[True, True\]"),
        (2, [0, 2], r"must be \(2,\) of True and False, one per world, or world indices from 0 to 1"),
        (3, [0, 2, 1], "must be"),  # may be statuses
        (3, [2, 0, 0], "must be"),
        (3, [-1], "must be"),
        (3, [True, False], "must be"),
        (3, [0, 0.5], "must be"),
    ],
)
def test_worlds_that_may_be_either_are_refused(worlds, mask, text):
    with pytest.raises(wf.ModelError, match=rf"^reset: mask = .*{text}"):
        worlds_mask("reset", mask, worlds)


def test_reset_takes_numbers_of_worlds():
    """Fails on 8934ce7: "mask has shape (2,), expected (3,)"."""
    sim = wf.Simulation(scene()[0].finalize(device="cpu", worlds=3), dt=2e-3)
    sim.step(2)
    sim.reset([0, 2])
    assert sim.time.tolist() == [0.0, 4e-3, 0.0]
    assert not sim.state.displacement.numpy()[[0, 2]].any()


# meshes


@pytest.mark.parametrize("corners", [(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)])
def test_an_inverted_tetrahedron_is_told_as_one(corners):
    """Two corners swapped, the mid-side nodes left. On 8934ce7: "mid-side nodes out of order: ... edge 12"."""
    m = wf.mesh.box((1, 1, 1), cells=(1, 1, 1))
    a, b = corners
    cells = m.cells.copy()
    cells[3, [a, b]] = cells[3, [b, a]]
    text = r"element 3 is inverted: its corners \[.*\] are numbered left-handed.*\(1 such element\); .*"
    with pytest.raises(wf.MeshError, match=text + rf"cells\[e, \[{a}, {b}\]\] = cells\[e, \[{b}, {a}\]\]"):
        wf.mesh.check(wf.mesh.Mesh(m.points, cells, "tetra10"))
    cells[3, [a, b]] = cells[3, [b, a]]
    wf.mesh.check(wf.mesh.Mesh(m.points, cells, "tetra10"))


# reprs


def test_reprs_have_five_lines_at_most():
    """On 8934ce7 `sim.last` of 64 worlds had 73 lines, a probe over 40 steps 151, this TriMesh 272."""
    density = np.linspace(1000.0, 2000.0, 12)
    b, bar = scene(material=wf.SVK(E=1e7, nu=0.3, density=density, damping=wf.KelvinVoigt(eta=100.0)))
    b.drive(bar.nodes("x+"), displacement=wf.Control("pull", 3), components="y")
    floor = b.add_collider(wf.HalfSpace((0, 0, 1), offset=-0.01), name="floor")
    model = b.finalize(device="cpu", worlds=64)
    sim = wf.Simulation(model, dt=1e-3)
    observed = sim.observe(
        *(f"{name}.{what}" for name in ("body.bar", "probe.tip") for what in ("position", "velocity"))
    )
    sim.step(40)
    ball = wf.TriMesh(*wf.Sphere((0, 0, 0), 0.1).mesh(24))
    values = {"time": np.linspace(0.0, 1.0, 40), "force": np.ones((64, 40, 3)), "moment": np.zeros((64, 40, 3))}
    names = [f.name for f in fields(ContactRecord) if f.name not in values]
    contact = ContactRecord(**values, **{name: np.linspace(-1.0, 1.0, 2560).reshape(64, 40) for name in names})
    records = [contact, JointRecord(**values, violation=np.full((64, 40), np.nan)), sim.probe("tip")]
    turn = wf.Rotation((0, 0, 0), (0, 0, 1), (np.linspace(0, 1, 500), np.linspace(0, 1, 500)))
    handles = [bar, bar.nodes("x-"), bar.surface("z-"), floor, bar.materials[0][1], turn]
    things = [
        sim,
        sim.last,
        sim.state,
        sim.controls,
        sim.controls["pull"],
        model,
        b,
        ball,
        observed,
        *records,
        *handles,
    ]
    for thing in things:
        text = repr(thing)
        assert text == str(thing)
        assert text.count("\n") < 5, text
        assert max(map(len, text.splitlines())) <= 200
        assert " object at 0x" not in text
    assert repr(sim.last).startswith("StepReport(converged=64 of 64 true, newton=array 64, ")
    assert "all 0.04" in repr(sim.last)  # the time
    assert repr(sim.probe("tip")).startswith("ProbeRecord(time=array 40, 0.001 to 0.04, position=array 64x40x3, ")
    assert repr(contact).count("=") == 12
    assert "moment=array 64x40x3, all 0" in repr(contact)
    assert repr(ball) == "TriMesh(266 points, 528 triangles, 0.2 x 0.2 x 0.2 m, closed, 0.004071 m^3)"
    assert repr(sim.state).startswith("State(64 worlds on cpu: displacement, velocity, time, ")
    one = wf.Simulation(scene()[0].finalize(device="cpu"), dt=2e-3)
    assert "converged=True, newton=" in repr(one.step())  # of one world the numbers


# names


def documented():
    return {name for name in vars(wf) if not name.startswith("_")} - {
        name for name, value in vars(wf).items() if isinstance(value, types.ModuleType)
    }


def test_dir_has_the_names_of_the_interface_and_no_others():
    """Fails on 8934ce7: Any, annotations, importlib, pathlib and sys were among them."""
    public = {name for name in dir(wf) if not name.startswith("_")}
    assert {name for name in wf.__all__ if not name.startswith("_")} <= public
    for name in public - set(wf.__all__):
        thing = getattr(wf, name)
        assert isinstance(thing, types.ModuleType), name
        assert thing.__name__ == f"warpfea.{name}"
    assert documented() <= set(wf.__all__)
    assert not hasattr(wf, "pathlib")


def test_every_name_of_the_interface_is_documented():
    for name in wf.__all__:
        thing = getattr(wf, name)
        assert isinstance(thing, str) or inspect.getdoc(thing), name


def test_type_checkers_see_the_interface():
    """The stub has the names of the package, and `study` with the types of its definition."""
    stub = ast.parse((ROOT / "warpfea" / "__init__.pyi").read_text())
    names = {alias.asname: (node.module, alias.name) for node in stub.body if isinstance(node, ast.ImportFrom)
             for alias in node.names}  # fmt: skip
    assert set(names) == set(wf.__all__)
    for name, (module, own) in names.items():
        assert name == own
        source = sys.modules.get(f"warpfea.{module}" if module else "warpfea")
        assert source is None or getattr(source, name) is getattr(wf, name)
    found = inspect.signature(wf.study)
    for parameter in found.parameters.values():
        assert parameter.annotation not in (inspect.Parameter.empty, typing.Any), parameter
        assert parameter.kind not in (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
    assert found.return_annotation is sys.modules["warpfea.studies.accuracy"].Study


@pytest.mark.slow
def test_mypy_sees_the_types_of_a_study(tmp_path):
    """Fails on 8934ce7: wf.study was Any, and so was whatever it returned."""
    pytest.importorskip("mypy")
    file = tmp_path / "use.py"
    file.write_text("import warpfea as wf\nreveal_type(wf.study('hook'))\nwf.study('hook', targets=1.0)\nwf.stduy\n")
    call = [sys.executable, "-m", "mypy", "--config-file", str(ROOT / "pyproject.toml"), str(file)]
    out = subprocess.run(call, cwd=ROOT, capture_output=True, text=True, check=False).stdout
    assert 'Revealed type is "warpfea.studies.accuracy.report.Study"' in out
    assert 'Unexpected keyword argument "targets" for "study"' in out
    assert 'has no attribute "stduy"' in out


# devices


@pytest.mark.skipif(wp.is_cuda_available(), reason="there is a GPU")
@pytest.mark.parametrize(
    "words",
    [
        ["run", "hook"],
        ["info", "hook"],
        ["bench"],
        ["profile", "cantilever"],
        ["stress", "--quick"],
        ["study", "cantilever", "--over", "dt=1e-2"],
    ],
)
def test_a_gpu_that_is_not_there_is_one_line(words, capfd):
    """Fails on 8934ce7: two lines of Warp's library before it, and the head of a table."""
    for device in ("cuda", "cuda:1"):
        assert main([*words, "--device", device]) == 2
        text = f"device '{device}' not found; available: cpu (no CUDA GPU with a driver); use 'cpu', or omit the device"
        assert capfd.readouterr() == ("", f"warpfea: error: {text}\n")


@pytest.mark.skipif(wp.is_cuda_available(), reason="there is a GPU")
def test_a_gpu_that_is_not_there_is_one_line_of_a_new_process():
    """With Warp's greeting, which a process shows once."""
    call = [sys.executable, "-m", "warpfea", "run", "hook", "--device", "cuda"]
    out = subprocess.run(call, capture_output=True, text=True, check=False, cwd=ROOT)
    assert (out.returncode, out.stdout, out.stderr.count("\n")) == (2, "", 1)
