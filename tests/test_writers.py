"""Writers beside a run: their thread, the worlds that they show, their price."""

import functools
import threading

import numpy as np
import pytest
from result_files import content_of

import warpfea as wf
from warpfea.base.background import MAX_WAITING, Background


def test_calls_in_the_background_keep_their_order_and_tell_errors():
    thread, done, gate = Background(), [], threading.Event()
    thread.call(gate.wait)
    for k in range(MAX_WAITING - 1):
        thread.call(done.append, k)
    assert not done  # they wait for the first, and this thread goes on
    gate.set()
    for k in range(MAX_WAITING - 1, 3 * MAX_WAITING):
        thread.call(done.append, k)
    thread.finish()
    assert done == list(range(3 * MAX_WAITING))
    gate.clear()
    thread.call(gate.wait)
    thread.call(lambda: 1 / 0)
    thread.call(done.append, "behind an error")
    gate.set()
    with pytest.raises(ZeroDivisionError):
        thread.finish()
    assert done[-1] == 3 * MAX_WAITING - 1
    gate.clear()
    thread.call(gate.wait)
    thread.call(done.append, "dropped")
    threading.Timer(0.05, gate.set).start()
    thread.stop()
    thread.finish()
    assert done[-1] == 3 * MAX_WAITING - 1


def test_some_worlds_are_those_of_all():
    """Points and fields of chosen worlds are those of all; the stress of later worlds is not computed."""
    b = wf.ModelBuilder()
    law = wf.SVK(E=1e7, nu=0.3, density=1e3)
    bar = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1)), material=law, name="b")
    b.clamp(bar.nodes("x-"))
    model = b.finalize(worlds=4, device="cpu")
    model.set_parameter("b.density", [1e3, 2e3, 3e3, 4e3])
    sim = wf.Simulation(model, dt=1e-3)
    sim.step(2)
    samples, launched = model.evaluation.samples, []
    before = samples.point_values
    samples.point_values = lambda *given: launched.append(before(*given)) or launched[-1]
    for chosen in ([2, 0], [1]):
        assert (sim.skin_points(bar, chosen) == sim.skin_points(bar)[chosen]).all()
        for name in ("von_mises", "displacement", "strain_energy_density"):
            assert (sim.skin_field(name, bar, chosen) == sim.skin_field(name, bar)[chosen]).all(), name
    assert [values.shape[0] for values in launched] == [3, 4, 2, 4]
    for chosen in ([4], [-1], [0.5], [], 0):
        for take in (sim.skin_points, functools.partial(sim.skin_field, "von_mises")):
            with pytest.raises(wf.ModelError, match="must be numbers from 0 to 3"):
                take(bar, chosen)
    assert np.ptp(sim.skin_field("von_mises", bar), axis=0).max() > 0.0


def test_two_outputs_of_one_file_and_names_too_long_for_it(tmp_path, monkeypatch):
    """The second would replace the first; a folder's name may be left out; a long name is cut in file names."""
    monkeypatch.chdir(tmp_path)
    b = wf.ModelBuilder()
    law = wf.SVK(E=1e7, nu=0.3, density=1e3)
    names = ["x" * 300, "x" * 200, "a/b", "a_b"]
    for k, name in enumerate(names):
        b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1), origin=(k, 0, 0)), material=law, name=name)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    kinds = {"a.html": wf.HTMLWriter, "a.usdc": wf.USDWriter, "a": wf.VTUWriter, "a.npz": wf.Checkpoint}
    for name, make in kinds.items():
        with pytest.raises(wf.OutputError, match=r"a[.a-z]*: two outputs write to it"):
            sim.run(1e-3, outputs=[make(name), make(tmp_path / name)])
        assert not (tmp_path / name).exists()
    sim.run(1e-3, outputs=[wf.VTUWriter("")])
    assert (tmp_path / f"{'x' * 100}-_0000_000000.vtu").exists()
    saved = wf.read_results(tmp_path)
    assert saved.bodies == names
    assert [round(saved.positions(name)[0, 0, :, 0].min()) for name in names] == [0, 1, 2, 3]
    for make in (wf.HTMLWriter, wf.USDWriter, wf.VTUWriter):
        for fields in (None, "J", [3]):
            with pytest.raises(wf.ModelError, match="fields must be names of fields"):
                make(tmp_path / "a", fields=fields)


def test_price_of_writers():
    """600 steps of 883k unknowns with the von Mises stress at 60 frames, in a page or in USD: 1.2 of those without."""
    content = content_of("writers_h200.json", "python tests/writers_price.py", "cuda")
    rows = {row["label"]: row for row in content["rows"]}
    assert content["machine"]["gpu"] == "NVIDIA H200"
    assert content["settings"]["unknowns"] == 883227
    assert not content["left_out"]
    assert all(row["steps"] == 600 and row["tip_difference"] <= 1e-12 for row in rows.values())
    for kind in ("HTML", "USD"):
        assert rows[kind]["ratio"] <= 1.2, rows[kind]
        assert rows[kind]["MB"] > 0.1


def test_price_of_a_gif():
    """Drawing 960 x 540 pixels takes no longer than the run of the README, nor than that of a ball in contact.

    In seconds of the processor: those of the clock are of a machine that others used.
    """
    content = content_of("gif_cpu.json", "python tests/gif_price.py", "cpu")
    rows = {row["label"]: row for row in content["rows"]}
    assert content["settings"]["size"] == [960, 540]
    for name in ("hook", "bouncing_ball"):
        row = rows[name]
        assert row["frames"] >= 40
        assert row["draw_processor_s"] <= row["run_processor_s"], row
