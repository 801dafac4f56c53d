"""Files and messages of a run: files that go on, statics, pictures, reprs, refusals, summaries."""

from __future__ import annotations

import json
import pathlib
from types import SimpleNamespace

import numpy as np
import pytest
from cli_runs import run as command

import warpfea as wf
from warpfea.base.errors import OutputError, UsageError
from warpfea.cli.mesh_scene import _parse_load
from warpfea.cli.summary import summarize, summary_text
from warpfea.outputs import animation, usd
from warpfea.outputs.frames import frame_time
from warpfea.outputs.usd import validate_usd

BOX = wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1))
LAW = wf.SVK(E=1e7, nu=0.3, density=1000.0)


def bar(material=LAW, gravity=(0, 0, -9.81), mesh=BOX, clamp=True, **options):
    """A builder with a bar that is clamped at x- and pulled down at x+, and its body."""
    b = wf.ModelBuilder(gravity=gravity)
    body = b.add_solid(mesh, material=material, name="bar", **options)
    if clamp:
        b.clamp(body.nodes("x-"))
        b.add_traction(body.surface("x+"), (0, 0, -200.0))
        b.add_probe("tip", body.surface("x+"))
    return b, body


def simulation(**options):
    return wf.Simulation(bar(**options)[0].finalize(device="cpu"), dt=2e-3)


# files


def codes(path):
    """Time codes of an animation, and the points of its last frame."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    (mesh,) = [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    times = mesh.GetPointsAttr().GetTimeSamples()
    return list(times), np.array(mesh.GetPointsAttr().Get(times[-1]))


def colours(path, code):
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    (mesh,) = [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    return np.array(mesh.GetDisplayColorPrimvar().Get(code))


def test_an_animation_goes_on_where_it_ended(tmp_path):
    whole, parts, check = tmp_path / "whole.usdc", tmp_path / "parts.usdc", tmp_path / "c.npz"
    simulation().run(0.02, outputs=[wf.USDWriter(whole, fps=500)])
    simulation().run(0.01, outputs=[wf.USDWriter(parts, fps=500), wf.Checkpoint(check)])
    sim = simulation()
    sim.resume(check)
    sim.run(0.02, outputs=[wf.USDWriter(parts, fps=500, extend=True)])
    assert validate_usd(parts) == []
    (times, last), (expected, points) = codes(parts), codes(whole)
    assert times == expected
    assert len(times) == 11
    np.testing.assert_array_equal(last, points)
    for code in (times[2], times[-1]):  # the colours of the first half are of the range of both
        np.testing.assert_allclose(colours(parts, code), colours(whole, code), atol=1e-6)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["c.npz", "parts.usdc", "whole.usdc"]


def test_an_animation_of_many_worlds_keeps_its_grid(tmp_path):
    from pxr import Usd

    def worlds():
        return wf.Simulation(bar()[0].finalize(device="cpu", worlds=2), dt=2e-3)

    def place():
        stage = Usd.Stage.Open(str(path))
        return tuple(stage.GetPrimAtPath("/World/world_0001").GetAttribute("xformOp:translate").Get())

    path, check = tmp_path / "o.usdc", tmp_path / "c.npz"
    worlds().run(0.006, outputs=[wf.USDWriter(path, fps=500), wf.Checkpoint(check)])
    before = place()
    sim = worlds()
    sim.resume(check)
    sim.run(0.012, outputs=[wf.USDWriter(path, fps=500, extend=True)])
    assert validate_usd(path) == []
    assert place() == before
    assert before[0] > 1.0


@pytest.mark.parametrize(
    ("options", "until", "text"),
    [
        ({"fps": 100}, 0.01, "frames per second is 500.0, of this run 100"),
        ({"fps": 500, "fields": []}, 0.01, "fields"),
        ({"fps": 500, "color": "displacement"}, 0.01, "field in colour"),
        ({"fps": 500}, 0.014, "its last frame, t = 0.014 s, is later than the checkpoint, t = 0.01 s"),
        ({"fps": 500}, 0.004, "it ends at t = 0.004 s.*frames are missing"),
    ],
)
def test_an_animation_that_does_not_fit_is_refused_and_kept(tmp_path, options, until, text):
    path, check = tmp_path / "o.usdc", tmp_path / "c.npz"
    simulation().run(until, outputs=[wf.USDWriter(path, fps=500)])
    simulation().run(0.01, outputs=[wf.Checkpoint(check)])
    before = path.read_bytes()
    sim = simulation()
    sim.resume(check)
    with pytest.raises(OutputError, match=f"o.usdc: can't go on with this file: .*{text}.*another file name"):
        sim.run(0.02, outputs=[wf.USDWriter(path, extend=True, **options)])
    assert path.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["c.npz", "o.usdc"]


def test_an_animation_of_something_else_is_refused(tmp_path):
    path, check = tmp_path / "o.usdc", tmp_path / "c.npz"
    simulation(gravity=(0, 0, 5000.0)).run(0.01, outputs=[wf.USDWriter(path, fps=500)])
    simulation().run(0.01, outputs=[wf.Checkpoint(check)])
    sim = simulation()
    sim.resume(check)
    with pytest.raises(OutputError, match="its last frame shows body 'bar' elsewhere"):
        sim.run(0.02, outputs=[wf.USDWriter(path, fps=500, extend=True)])
    other = wf.Simulation(bar(mesh=wf.mesh.box((1, 0.2, 0.2), cells=(3, 1, 1)))[0].finalize(device="cpu"), dt=2e-3)
    other.run(0.01)
    with pytest.raises(OutputError, match="body 'bar' is not in it, or has another mesh"):
        other.run(0.02, outputs=[wf.USDWriter(path, fps=500, extend=True)])
    path.write_text("no stage")
    with pytest.raises(OutputError, match=r"o\.usdc"):
        sim.run(0.02, outputs=[wf.USDWriter(path, fps=500, extend=True)])
    assert path.read_text() == "no stage"


def test_a_series_for_paraview_goes_on(tmp_path):
    whole, parts, check = tmp_path / "whole", tmp_path / "parts", tmp_path / "c.npz"
    simulation().run(0.02, outputs=[wf.VTUWriter(whole, fps=250)])
    simulation().run(0.012, outputs=[wf.VTUWriter(parts, fps=250), wf.Checkpoint(check)])
    sim = simulation()
    sim.resume(check)
    sim.run(0.02, outputs=[wf.VTUWriter(parts, fps=250, extend=True)])
    texts = [(folder / f"{folder.name}.pvd").read_text() for folder in (whole, parts)]
    assert texts[0] == texts[1]
    assert texts[0].count("<DataSet") == 6
    names = [sorted(p.name for p in folder.iterdir() if p.suffix == ".vtu") for folder in (whole, parts)]
    assert names[0] == names[1]


def test_a_series_leaves_out_what_comes_after_the_checkpoint(tmp_path):
    folder, check = tmp_path / "vtu", tmp_path / "c.npz"
    simulation().run(0.008, outputs=[wf.Checkpoint(check)])
    simulation().run(0.02, outputs=[wf.VTUWriter(folder, fps=250)])
    listed = folder / "vtu.pvd"
    before = listed.read_text()
    sim = simulation()
    sim.resume(check)
    writer = wf.VTUWriter(folder, fps=250, extend=True)
    writer.open(sim)
    writer.close(sim)
    assert listed.read_text().count("<DataSet") == 3
    sim.run(0.02, outputs=[writer])
    assert listed.read_text() == before
    listed.write_text("<VTKFile>")
    with pytest.raises(OutputError, match=r"vtu\.pvd: can't go on with this series .*another folder"):
        sim.run(0.03, outputs=[wf.VTUWriter(folder, extend=True)])
    assert listed.read_text() == "<VTKFile>"


def test_usd_speaks_our_words(tmp_path, monkeypatch):
    from pxr import Tf, Usd

    target = pathlib.Path("/proc/o.usdc")
    if target.parent.is_dir():
        with pytest.raises(OutputError, match=r"/proc/o.usdc: .*(cannot write|not writable)"):
            wf.USDWriter(target).open(simulation())
    try:
        Usd.Stage.Open(str(tmp_path / "none.usdc"))
        pytest.fail("USD opens what is not there")
    except Tf.ErrorException as error:
        raw = error
    assert "line" in str(raw)

    def fail(_):
        raise raw

    monkeypatch.setattr(usd, "check_target", lambda path, suffixes: pathlib.Path(path))
    monkeypatch.setattr(Usd.Stage, "CreateNew", fail)
    with pytest.raises(OutputError) as told:
        wf.USDWriter(tmp_path / "o.usdc").open(simulation())
    text = str(told.value)
    assert text.startswith(f"{tmp_path / 'o.usdc'}: can't be written (")
    assert "none.usdc" in text
    for word in ("pxrInternal", ".cpp", "line", "\n", "Error in"):
        assert word not in text


# statics


def labels(monkeypatch):
    """Collects what is written under pictures."""
    seen = []
    label = animation.draw_labels

    def note(image, time, *more):
        seen.append(time)
        return label(image, time, *more)

    monkeypatch.setattr(animation, "draw_labels", note)
    return seen


def test_statics_write_outputs_and_say_the_load(tmp_path, monkeypatch):
    seen = labels(monkeypatch)
    model = bar()[0].finalize(device="cpu")
    small = {"size": (160, 90)}
    outputs = [
        wf.PNGWriter(tmp_path / "o.png", **small),
        wf.GIFWriter(tmp_path / "o.gif", progress=False, **small),
        wf.USDWriter(tmp_path / "o.usdc"),
        wf.VTUWriter(tmp_path / "vtu"),
    ]
    static = wf.solve_static(model, load_steps=4, outputs=outputs)
    assert seen[0] == "load 100 %"
    assert seen[-5:] == ["load 0 %", "load 25 %", "load 50 %", "load 75 %", "load 100 %"]
    assert validate_usd(tmp_path / "o.usdc") == []
    assert len(codes(tmp_path / "o.usdc")[0]) == 5
    assert (tmp_path / "vtu" / "vtu.pvd").read_text().count("<DataSet") == 5
    assert static.state.time.numpy().max() == 0.0
    # a picture that is made afterwards, as of any simulation, and one of the file
    seen.clear()
    picture = wf.PNGWriter(tmp_path / "later.png", **small)
    picture.open(static.simulation)
    picture.close(static.simulation)
    from warpfea.outputs.render import render_usd

    render_usd(tmp_path / "o.usdc", tmp_path / "usd.png", size=(160, 90))
    assert seen == ["load 100 %", "load 100 %"]
    assert frame_time(static.simulation) == 1.0


def test_a_motion_still_says_the_time(tmp_path, monkeypatch):
    seen = labels(monkeypatch)
    simulation().run(0.004, outputs=[wf.PNGWriter(tmp_path / "o.png", size=(160, 90))])
    assert len(seen) == 1
    assert seen[0].startswith("t = 0.004")


def test_a_load_step_that_fails_is_told_by_the_load():
    b, body = bar()
    b.add_traction(body.surface("x+"), (0, 0, -1e30))
    solver = wf.NewtonPCG(max_halvings=0)
    with pytest.raises(wf.ConvergenceError, match=r"load step from 0 % to 50 % of the load was not accepted"):
        wf.solve_static(b.finalize(device="cpu"), load_steps=2, solver=solver)


# pictures


def test_fields_and_colours_are_checked_before_the_first_step(tmp_path):
    for writer in (
        wf.PNGWriter(tmp_path / "o.png", field="von_misses"),
        wf.GIFWriter(tmp_path / "o.gif", field="von_misses"),
        wf.USDWriter(tmp_path / "o.usdc", color="von_misses"),
        wf.VTUWriter(tmp_path / "vtu", fields=["von_misses"]),
    ):
        sim = simulation()
        with pytest.raises(wf.ModelError, match=r"'von_misses' is unknown.*did you mean 'von_mises'"):
            sim.run(0.01, outputs=[writer])
        assert sim.steps == 0
    for bad in ((1.0, 1.0), (2.0, 1.0), (0.0, np.nan), 3.0, "ab"):
        for kind in (wf.PNGWriter, wf.GIFWriter, wf.USDWriter):
            name = {wf.PNGWriter: "o.png", wf.GIFWriter: "o.gif", wf.USDWriter: "o.usdc"}[kind]
            with pytest.raises(OutputError, match="color_range"):
                kind(tmp_path / name, color_range=bad)
    assert list(tmp_path.iterdir()) == []


# what things say of themselves


def test_reprs_are_one_informative_line():
    b, body = bar()
    assert repr(wf.ModelBuilder()) == "ModelBuilder(no bodies)"
    assert repr(b) == "ModelBuilder(Body('bar', T10, 12 elements), 1 support, 1 load, 1 probe)"
    model = b.finalize(device="cpu")
    sim = wf.Simulation(model, dt=2e-3)
    sim.step(2)
    assert repr(sim) == (
        f"Simulation(t = 0.004 s, 2 steps, dt = 0.002 s, backward_euler, newton-pcg, {model.slots} slots, cpu, float64)"
    )
    static = wf.solve_static(model, load_steps=2)
    assert repr(static.simulation).startswith("Simulation(static, load 100 %, 2 load steps, ")
    assert repr(static).startswith("StaticResult(2 load steps, ")
    many = wf.ModelBuilder()
    for _ in range(5):
        many.add_solid(BOX, material=LAW)
    assert repr(many) == "ModelBuilder(5 bodies)"
    for thing in (b, sim, static, many, body):
        assert "\n" not in repr(thing)
        assert len(repr(thing)) < 200


# what is refused, and what a summary says

LITTLE = ["cantilever", "--device", "cpu", "--set", "cells=2", "--dt", "0.002"]


def sheet(path):
    """A mesh of quads in a file."""
    import meshio

    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    meshio.write(path, meshio.Mesh(points, [("quad", np.array([[0, 1, 2, 3]]))]))
    return path


def test_an_element_turned_inside_out_is_told(tmp_path, capfd):
    path = tmp_path / "a.json"
    code, out, _ = command(capfd, "run", *LITTLE, "--t-end", "0.004", "--json", path)
    assert code == 0
    assert 0.5 < json.loads(path.read_text())["min_J"] < 1.0
    assert "inside out" not in out
    sim = simulation()
    assert sim.min_J == np.inf
    steps = [sim.step().min_J[0] for _ in range(2)]
    assert sim.min_J == min(steps)
    crushed = bar(wf.SVK(E=10.0, nu=0.3, density=1000.0), gravity=(-300.0, 0, 0))[0].finalize(device="cpu")
    with pytest.raises(wf.ConvergenceError, match=r"inverted \(J <= 0\).*worst element .* of body .*NeoHookean"):
        wf.Simulation(crushed, dt=2e-3).run(0.1)
    sim = wf.Simulation(crushed, dt=2e-3, inversion="report")
    sim.run(0.1, on_step=lambda s: s.min_J > 0)
    assert sim.min_J <= 0
    source = SimpleNamespace(label="bar", parameters={})
    summary = summarize(source, sim, status="done", wall_s=0.0)
    assert f"an element turned inside out: J = {sim.min_J:.3g}; take a finer mesh" in summary_text(summary, sim, [])
    stiffening = bar(wf.NeoHookean.from_E_nu(E=1e6, nu=0.3, density=1000.0))[0].finalize(device="cpu")
    sim = wf.Simulation(stiffening, dt=2e-3)
    sim.step()
    summary = summarize(source, sim, status="done", wall_s=0.0) | {"min_J": -0.1}
    assert "J = -0.1 at a vertex of an element: take a finer mesh or smaller loads" in summary_text(summary, sim, [])


def test_what_was_not_written_is_not_listed(tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, file in {"--png": "a.png", "--gif": "a.gif", "--usd": "a.usdc"}.items():
        code, out, err = command(capfd, "run", *LITTLE, "--t-end", "0.004", name, file, "--field", "foo")
        assert (code, out) == (2, "")
        assert "--field foo: is unknown; there are von_mises, displacement, J, strain_energy_density, " in err
    (tmp_path / "old.png").write_text("older")

    def fail(*_):
        raise OutputError("old.png: can't be written")

    monkeypatch.setattr(wf.PNGWriter, "close", fail)
    words = ["--png", "old.png", "--checkpoint", "c.npz", "--json", "a.json"]
    code, out, _ = command(capfd, "run", *LITTLE, "--t-end", "0.004", *words)
    assert code == 4
    wrote = out[out.index("wrote") :]
    assert "old.png" not in wrote
    assert "c.npz" in wrote
    assert "a.json" in wrote


def test_an_end_that_no_step_reaches_is_refused():
    for t_end, text in {1e-9: "within 1e-06 dt of the start", -1.0: "lies in the past"}.items():
        sim = simulation()
        with pytest.raises(wf.ModelError, match=text):
            sim.run(t_end)
        assert sim.steps == 0
    sim.run(5e-3)  # two steps and a half of one
    assert sim.steps == 3
    sim.run(5e-3)
    sim.run(5e-3 + 1e-9)  # no step of its own
    assert sim.steps == 3
    with pytest.raises(wf.ModelError, match=r"t_end = 0.001 s lies in the past: the simulation is at t = 0.005 s"):
        sim.run(1e-3)
    sim.reset()
    sim.run(5e-4)
    assert sim.time[0] == 5e-4


def test_the_summary_has_the_end_that_was_asked_for(capfd):
    """Fails on 8934ce7: it ended at 0.004 s, the whole steps nearest to it."""
    code, out, _ = command(capfd, "run", *LITTLE, "--t-end", "0.005")
    assert code == 0
    assert "done at t = 0.005 s, 3 steps of 0.002 s, the last shorter" in out
    assert "shorter" not in command(capfd, "run", *LITTLE, "--t-end", "0.004")[1]


def test_the_summary_says_that_rounding_set_the_limit():
    sim = wf.Simulation(bar()[0].finalize(device="cpu", dtype="float32"), dt=2e-3)
    sim.step()
    summary = summarize(SimpleNamespace(label="bar", parameters={}), sim, status="done", wall_s=0.0)
    assert (summary["floored_steps"], summary["max_floor"]) == (0, 0.0)
    assert "rounding" not in summary_text(summary, sim, [])
    summary |= {"floored_steps": 1, "max_floor": 1.234e-3}
    text = "1 of 1 steps end where rounding stops the residual; largest estimated error 0.0012"
    assert text in summary_text(summary, sim, [])
    summary["floored_steps"] = 0
    summary["steps"] = 0
    assert "residual up to" not in summary_text(summary, sim, [])
    assert "no step was accepted" in summary_text(summary, sim, [])


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--png-time", "0.002"], "--png-time is for a picture: give --png too"),
        (["--png-time", "0.5", "--png", "a.png"], "--png-time 0.5: the run lasts from 0 to t = 0.004 s"),
        (["--every", "5"], "--every is for checkpoints: give --checkpoint too"),
        (["--fps", "5", "--gif", "a.gif"], "--fps is for animations: give --usd or --vtu or --html too"),
        (["--speed", "5", "--usd", "a.usdc"], "--speed is for an animation: give --gif too"),
        (["--usd", "a.usdc", "--usd", "b.usdc"], "--usd is given twice"),
        (["--t-end", "1e-9"], "--t-end 1e-09: less than"),
        (["--foo", "1"], "unknown option: --foo 1 ("),
    ],
)
def test_options_without_effect_are_refused(tmp_path, capfd, monkeypatch, words, text):
    monkeypatch.chdir(tmp_path)
    code, out, err = command(capfd, "run", *LITTLE, "--t-end", "0.004", *words)
    assert (code, out) == (2, "")
    assert text in err
    assert list(tmp_path.iterdir()) == []


def test_a_mesh_of_a_surface_is_one_of_a_shell(tmp_path, capfd):
    code, out, _ = command(capfd, "info", sheet(tmp_path / "quad.vtu"))
    assert code == 0
    assert "add_shell" in out
    assert "--material" not in out


def test_falling_is_told_of_what_falls(capfd):
    cube = pathlib.Path(__file__).resolve().parent / "data" / "S2_cube.msh"
    words = [cube, "--material", "svk:E=1e7,nu=0.3,density=1000", "--device", "cpu"]
    assert "falls freely" in command(capfd, "info", *words)[2]
    assert command(capfd, "info", *words, "--gravity", "0,0,0")[2] == ""
    assert "falls freely" not in command(capfd, "run", *words, "--static")[2]


def test_words_of_the_command_line(tmp_path, capfd):
    folder = tmp_path / "dir.msh"
    folder.mkdir()
    for words in (["info", folder], ["run", folder, "--material", "svk:E=1e7,nu=0.3"]):
        assert f"{folder}: is a folder, not a file" in command(capfd, *words)[2]
    _, _, err = command(capfd, "sweeep")
    assert "did you mean 'sweep'" in err
    with pytest.raises(UsageError, match=r"'nan' is not a finite number$"):
        _parse_load("x+:nan", "--pressure", 1)


def test_an_error_in_a_scene_file_has_its_line(tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "err.py").write_text("x = 1\ny = x / 0\n")
    code, _, err = command(capfd, "run", "err.py")
    assert code == 2
    assert "err.py:2: ZeroDivisionError: division by zero" in err


def test_a_refused_step_says_what_to_try():
    b, body = bar()
    b.add_traction(body.surface("x+"), (0, 0, -1e30))
    overload = r"the traction of 1e\+30 Pa .* check the units of load and E$"
    model, solver = b.finalize(device="cpu"), wf.NewtonPCG(max_halvings=0)
    with pytest.raises(wf.ConvergenceError, match=f"; try a smaller dt; {overload}"):
        wf.Simulation(model, dt=2e-3, solver=solver).step()
    with pytest.raises(wf.ConvergenceError, match=f"; try more load steps; {overload}"):
        wf.solve_static(model, load_steps=1, solver=solver)


def test_ctrl_c_while_a_command_is_read_is_no_traceback(capfd, monkeypatch):
    def interrupt(_):
        raise KeyboardInterrupt

    monkeypatch.setattr("warpfea.cli.parser.parse", interrupt)
    assert command(capfd, "scenes") == (130, "", "warpfea: interrupted\n")
