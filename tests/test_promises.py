"""State after a failure: the promises of warpfea/simulation/README.md, one after the other."""

import contextlib
import itertools
import pathlib
import signal
import subprocess
import sys
import textwrap
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
import warp as wp
from PIL import Image

import warpfea as wf
from warpfea.cli import main
from warpfea.outputs.usd import validate_usd

resource = pytest.importorskip("resource", reason="limits on files are POSIX")

BOX = wf.mesh.box((1, 0.2, 0.2), cells=(4, 1, 1))
LAW = wf.SVK(E=1e7, nu=0.3, density=1000.0)
DT = 2e-3


@wp.func
def nan_later(t: wp.float64) -> wp.vec3d:  # Pa
    zero = wp.float64(0.0)
    fall = wp.where(t > wp.float64(0.007), zero / zero, wp.float64(-100.0))
    return wp.vec3d(zero, zero, fall)


def builder(traction=(0, 0, -200.0)):
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    body = b.add_solid(BOX, material=LAW, name="bar")
    b.clamp(body.nodes("x-"))
    b.add_traction(body.surface("x+"), traction)
    b.add_probe("tip", body.surface("x+"))
    return b


def simulation(**options):
    return wf.Simulation(builder(**options).finalize(device="cpu"), dt=DT)


def values(sim):
    return {name: array.copy() for name, array in sim.state.numpy().items()}


def names(folder):
    return sorted(p.name for p in pathlib.Path(folder).iterdir())


def writers(folder):
    """One of each kind, and the file of each that is there once it is done."""
    return {
        "usdc": (wf.USDWriter(folder / "o.usdc"), "o.usdc"),
        "usda": (wf.USDWriter(folder / "o.usda"), "o.usda"),
        "vtu": (wf.VTUWriter(folder / "o"), "o/o.pvd"),
        "png": (wf.PNGWriter(folder / "o.png", size=(64, 48)), "o.png"),
        "gif": (wf.GIFWriter(folder / "o.gif", size=(64, 48), progress=False), "o.gif"),
        "npz": (wf.Checkpoint(folder / "o.npz", every=2), "o.npz"),
    }


KINDS = list(writers(pathlib.Path()))


def check_file(path):
    """The file is whole, by its own format. (meshio is imported late: CUDA tests are collected without it.)"""
    if path.suffix in (".usdc", ".usda"):
        assert validate_usd(path) == []
    elif path.suffix in (".png", ".gif"):
        with Image.open(path) as picture:
            for k in range(getattr(picture, "n_frames", 1)):
                picture.seek(k)
                picture.load()
    elif path.suffix == ".npz":
        simulation().resume(path)
    else:
        import meshio

        entries = list(ElementTree.parse(path).getroot().iter("DataSet"))
        assert entries
        for entry in entries:
            meshio.read(path.parent / entry.attrib["file"])


# values that are not finite


@pytest.mark.parametrize("load", ["constant", "samples"])
def test_nan_in_a_load_is_refused_as_it_is_given(load):
    bad = (0, 0, np.nan)
    with pytest.raises(wf.ModelError, match=r"traction.*nan"):
        builder(traction=bad if load == "constant" else ([0, 1], [(0, 0, 0), bad]))


def test_nan_in_a_load_of_a_step_names_the_time_and_keeps_the_state(tmp_path):
    """The law is NaN after 7 ms: the steps to 6 ms stay, the next is refused and can be tried again."""
    sim = simulation(traction=nan_later)
    out, file = writers(tmp_path)["usdc"]
    kept = []
    with pytest.raises(wf.ConvergenceError, match=r"step from t = 0\.006 s.* was not accepted.*not finite") as caught:
        sim.run(0.02, outputs=[out], on_step=lambda s: kept.append(values(s)))
    assert (sim.steps, caught.value.time, caught.value.world) == (3, pytest.approx(0.006), 0)
    assert caught.value.state is sim.state
    after = values(sim)
    for name in ("displacement", "velocity", "time", "ledger"):
        assert np.isfinite(after[name]).all()
        np.testing.assert_array_equal(after[name], kept[-1][name])
    check_file(tmp_path / file)
    assert sim.probe("tip").time[-1] == pytest.approx(0.006)
    sim.dt = 5e-4  # 6.5 ms lies before the first NaN
    assert sim.step().converged.all()


# killed while it writes

KILLED = textwrap.dedent("""
    import os, random, signal, sys, time
    import numpy as np
    sys.path.insert(0, {tests!r})
    import test_promises as t
    from warpfea.simulation.checkpoint import read_meta, save_checkpoint

    path = {path!r}
    sim = t.simulation()
    sim.step()
    save_checkpoint(sim, path)
    random.seed(1)
    for k in range(25):
        child = os.fork()
        if child == 0:
            while True:
                sim.steps += 1
                save_checkpoint(sim, path)
        time.sleep(random.uniform(0.003, 0.02))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        steps = read_meta(path)["steps"]
        assert steps >= 1
        with np.load(path) as data:
            assert all(np.isfinite(data[name]).all() for name in data.files)
    print("whole after", k + 1, "kills")
""")


def test_a_kill_leaves_the_old_checkpoint_or_the_new_one(tmp_path):
    """SIGKILL at random moments of a process that does nothing but write: what is there is whole, and resumes."""
    path = tmp_path / "c.npz"
    script = KILLED.format(tests=str(pathlib.Path(__file__).parent), path=str(path))
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert "whole after 25 kills" in done.stdout
    fresh = simulation()
    fresh.step(2)
    sim = simulation()
    sim.resume(path)
    sim.step()
    np.testing.assert_array_equal(values(sim)["displacement"], values(fresh)["displacement"])
    # a kill in the middle of a file may leave its hidden beginning, never another name
    assert all(name == "c.npz" or (name.startswith(".c.") and ".part" in name) for name in names(tmp_path))


# a disk that is full


@contextlib.contextmanager
def disk_of(size):
    """No file may grow beyond `size` bytes: the system refuses what goes beyond, as a full disk does."""
    before, limits = signal.getsignal(signal.SIGXFSZ), resource.getrlimit(resource.RLIMIT_FSIZE)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)


@pytest.mark.parametrize("share", [0.0, 0.6], ids=["first bytes", "midway"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_full_disk_is_an_output_error_and_keeps_the_old_file(kind, share, tmp_path, capfd):
    out, file = writers(tmp_path)[kind]
    simulation().run(3 * DT, outputs=[out])
    old = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    size = max(64, int(share * max(map(len, old.values()))))
    sim = simulation()
    with capfd.disabled(), disk_of(size), pytest.raises(wf.OutputError, match=r"\bo\b.*can't be written"):
        sim.run(6 * DT, outputs=[out])
    after = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    if (kind, share) == ("vtu", 0.6):  # a new series takes the place of the old one frame by frame
        assert after.keys() == old.keys()
    else:
        assert after == old
    check_file(tmp_path / file)
    assert sim.step().converged.all()  # the simulation is sound
    out.open(sim)  # and so is the writer
    out.abort()


@pytest.mark.parametrize("kind", KINDS)
def test_a_full_disk_leaves_no_half_of_a_new_file(kind, tmp_path, tmp_path_factory, capfd):
    simulation().run(DT, outputs=[writers(tmp_path_factory.mktemp("once"))[kind][0]])  # kernels are compiled to disk
    out, _ = writers(tmp_path)[kind]
    with capfd.disabled(), disk_of(64), pytest.raises(wf.OutputError, match="can't be written"):
        simulation().run(4 * DT, outputs=[out])
    assert [p for p in tmp_path.rglob("*") if p.is_file()] == []


# interrupted while it writes


class Interruption:
    """A writer that is interrupted, or fails, as it writes for the third time."""

    def __init__(self, error):
        self.error = error
        self.calls = itertools.count()

    def open(self, sim):
        pass

    def write(self, sim):
        if next(self.calls) == 2:
            raise self.error

    def close(self, sim):
        pass

    abort = open


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ValueError("a defect")], ids=["Ctrl-C", "defect"])
def test_an_interrupted_writer_leaves_the_files_of_the_others_valid(error, tmp_path):
    made = writers(tmp_path)
    first, last = [out for out, _ in made.values()][:3], [out for out, _ in made.values()][3:]
    sim = simulation()
    with pytest.raises(type(error)):
        sim.run(6 * DT, outputs=[*first, Interruption(error), *last])
    assert sim.steps == 2
    for _, file in made.values():
        check_file(tmp_path / file)
    assert not [p for p in tmp_path.rglob("*") if ".part" in p.name]


def test_ctrl_c_gives_up_one_output_and_finishes_the_others(tmp_path, monkeypatch):
    """Pressed again while a picture is drawn: that one is left out."""
    made = writers(tmp_path)
    png, file = made.pop("png")

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("warpfea.outputs.animation.Animation.save_png", interrupted)
    with pytest.raises(KeyboardInterrupt):
        simulation().run(3 * DT, outputs=[png, *[out for out, _ in made.values()]])
    for _, other in made.values():
        check_file(tmp_path / other)
    assert not (tmp_path / file).exists()


def break_off(monkeypatch, kind, error):
    """Let what writes a file of this kind raise after it has begun the file."""

    def begun(target, *_, **__):
        target = pathlib.Path(getattr(target, "name", target))
        target.write_bytes(b"half of")
        raise error

    if kind == "npz":
        monkeypatch.setattr(np, "savez", begun)
    elif kind == "vtu":
        import meshio

        monkeypatch.setattr(meshio.Mesh, "write", lambda self, path, **_: begun(path))
    elif kind in ("png", "gif"):
        monkeypatch.setattr(Image.Image, "save", lambda self, path, *_, **__: begun(path))
    else:
        monkeypatch.setattr(wf.USDWriter, "_save", lambda self: begun(self._temporary))


@pytest.mark.parametrize("error", [KeyboardInterrupt(), RuntimeError("a defect")], ids=["Ctrl-C", "defect"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_write_that_breaks_off_leaves_the_old_file_or_none(kind, error, tmp_path, monkeypatch):
    for there in (False, True):
        folder = tmp_path / str(there)
        folder.mkdir()
        out, file = writers(folder)[kind]
        if there:
            simulation().run(3 * DT, outputs=[out])
        old = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
        with monkeypatch.context() as patch:
            break_off(patch, kind, error)
            with pytest.raises(type(error)):
                simulation().run(6 * DT, outputs=[out])
        assert {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()} == old
        if there:
            check_file(folder / file)


# a device without room


def out_of_memory(monkeypatch, after):
    """Let the device refuse every allocation after so many, as Warp says it on CUDA."""
    count, zeros = itertools.count(), wp.zeros

    def refuse(shape, *args, **kwargs):
        if next(count) >= after:
            raise RuntimeError("Failed to allocate 123456789 bytes on device 'cuda:0'")
        return zeros(shape, *args, **kwargs)

    monkeypatch.setattr(wp, "zeros", refuse)


@pytest.mark.parametrize("after", [0, 3, 20, 60])
def test_a_device_out_of_memory_is_a_capacity_error(after, monkeypatch):
    """State and simulation say which array, how many bytes, and what to do; there is room again afterwards."""
    model = builder().finalize(device="cpu")
    out_of_memory(monkeypatch, after)
    with pytest.raises(wf.CapacityError, match=r"array '\w.*123456789 bytes \(123.5 MB\).*take fewer worlds") as caught:
        wf.Simulation(model, dt=DT)
    assert caught.value.bytes == 123456789
    monkeypatch.undo()
    assert wf.Simulation(model, dt=DT).step().converged.all()


def test_a_model_or_a_step_out_of_memory_is_a_capacity_error(monkeypatch):
    sim = simulation()

    def refuse(*_, **__):
        raise RuntimeError("Failed to allocate 4096 bytes on device 'cuda:0'")

    with monkeypatch.context() as patch:
        patch.setattr(wp, "array", refuse)
        with pytest.raises(wf.CapacityError, match=r"a model with 7 worlds: .* 4096 bytes"):
            builder().finalize(device="cpu", worlds=7)
    with monkeypatch.context() as patch:
        patch.setattr(wp, "capture_launch", refuse)
        with pytest.raises(wf.CapacityError, match=r"a step: .* 4096 bytes"):
            sim.step()
    assert sim.step().converged.all()


def test_other_errors_of_the_device_stay_what_they_are(monkeypatch):
    sim = simulation()

    def fail(*_, **__):
        raise RuntimeError("a defect")

    monkeypatch.setattr(wp, "capture_launch", fail)
    with pytest.raises(RuntimeError, match=r"^a defect$"):
        sim.step()


def test_too_many_worlds_for_the_host_are_a_capacity_error():
    with pytest.raises((wf.CapacityError, wf.ModelError), match="take fewer worlds"):
        wf.Simulation(builder().finalize(device="cpu", worlds=10**12), dt=DT)


def test_a_command_without_memory_exits_2(capfd, monkeypatch):
    out_of_memory(monkeypatch, 20)
    code = main(["run", "cantilever", "--device", "cpu", "--set", "cells=2", "--t-end", "0.01", "--dt", "0.002"])
    _, err = capfd.readouterr()
    assert code == 2
    assert err.startswith("warpfea: error: array ")
    assert "123456789 bytes" in err


@pytest.mark.cuda
def test_too_many_worlds_for_a_gpu_are_a_capacity_error():
    """By name; whether the GPU can be used afterwards depends on the driver: a new process can."""
    total = wp.get_device("cuda:0").total_memory
    with pytest.raises((wf.CapacityError, wf.ModelError), match="take fewer worlds"):
        wf.Simulation(builder().finalize(device="cuda:0", worlds=total // 1000), dt=DT)


# bad input


def test_a_bad_mesh_is_a_mesh_error_that_names_file_and_element(tmp_path, capfd):
    """One inverted tetrahedron, and a file that is cut off."""
    import meshio

    cells = np.array(BOX.cells)
    cells[3] = cells[3, [1, 0, 2, 3, 4, 6, 5, 8, 7, 9]]
    bad, cut = tmp_path / "bad.vtu", tmp_path / "cut.vtu"
    meshio.Mesh(BOX.points, [("tetra10", cells)]).write(bad)
    cut.write_bytes(bad.read_bytes()[:500])
    for path, text in ((bad, "element 3 is inverted"), (cut, "")):
        with pytest.raises(wf.MeshError, match=rf"^{path}: .*{text}"):
            wf.ModelBuilder().add_solid(str(path), material=LAW)
        code = main(["run", str(path), "--material", "svk:E=1e7,nu=0.3,density=1000", "--t-end", "0.002"])
        out, err = capfd.readouterr()
        assert (code, out) == (2, "")
        assert err.startswith(f"warpfea: error: {path}: ")


@pytest.mark.parametrize("device", ["cuda:7", "gpu"])
def test_a_wrong_device_is_a_model_error_that_lists_those_there_are(device, capfd):
    with pytest.raises(wf.ModelError, match=rf"device '{device}' not found; available: cpu"):
        builder().finalize(device=device)
    code = main(["run", "cantilever", "--device", device, "--t-end", "0.002"])
    out, err = capfd.readouterr()
    assert (code, out) == (2, "")
    assert f"device '{device}' not found; available: cpu" in err
