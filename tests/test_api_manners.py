"""Messages of the Python interface for wrong arguments: handles of other models, constants, densities, files."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import warpfea as wf
from warpfea.base.errors import OutputError
from warpfea.studies.profile.profiling import _empty_launch_seconds


def builder(density=1000.0, gravity=(0, 0, 0), size=(1, 0.2, 0.2)):
    b = wf.ModelBuilder(gravity=gravity)
    material = wf.SVK(E=1e6, nu=0.3, density=density)
    body = b.add_solid(wf.mesh.box(size, cells=(2, 1, 1)), material=material, name="bar")
    b.clamp(body.nodes("x-"))
    return b, body


def test_results_are_of_bodies_of_the_model():
    b, body = builder()
    other = builder()[1]
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    asked = {
        "displacements": sim.displacements,
        "positions": sim.positions,
        "velocities": sim.velocities,
        "field": lambda thing: sim.field("von_mises", thing),
        "node_gradients": sim.node_gradients,
    }
    for name, ask in asked.items():
        with pytest.raises(wf.ModelError, match=f"{name}.*body 'bar' is not of this model"):
            ask(other)
        with pytest.raises(wf.ModelError, match=f"{name}.*expected a body, by the handle .*'bar'.*got 'bar'"):
            ask("bar")
    with pytest.raises(wf.ModelError, match="reaction: body 'bar' is not of this model"):
        sim.reaction(other.nodes("x-"))
    assert sim.positions(body).shape == (1, len(body.mesh.points), 3)


def test_laws_name_the_way_by_E_and_nu():
    for law in (wf.NeoHookean, wf.MooneyRivlin):
        with pytest.raises(wf.ModelError, match=rf"{law.__name__}\.from_E_nu"):
            law(E=1e6, nu=0.3, density=1000.0)
        assert law.from_E_nu(E=1e6, nu=0.3).lame == pytest.approx(wf.SVK(E=1e6, nu=0.3).lame)
    with pytest.raises(TypeError):
        wf.NeoHookean(mu=1e6)


def test_units_that_look_wrong_are_asked_about():
    with pytest.warns(wf.MeshWarning, match=r"the density of SVK is 7\.85e-09 kg/m\^3. Is it in another unit"):
        builder(7.85e-9)[0].finalize(device="cpu")
    with pytest.warns(wf.MeshWarning, match="lengths are in metres"):
        builder(size=(2e3, 0.2, 0.2))[0].finalize(device="cpu")
    for density in (1.0, 1e6, np.array([1.0, 20.0] * 6), lambda X: 1000.0 + X[:, 0]):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            builder(density)[0].finalize(device="cpu")


def test_a_mesh_in_mm_is_asked_about(tmp_path):
    import meshio

    mesh = wf.mesh.box((2000.0, 20.0, 20.0), cells=(2, 1, 1), element="T4")
    meshio.Mesh(mesh.points, [("tetra", mesh.cells)]).write(tmp_path / "part.vtu")
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    b.add_solid(tmp_path / "part.vtu", material=wf.SVK(E=1e6, nu=0.3))
    with pytest.warns(wf.MeshWarning, match=r"part\.vtu is in mm, give scale=1e-3 \(--scale 1e-3\)"):
        b.finalize(device="cpu")


def test_gravity_without_density_asks_for_the_density_alone():
    with pytest.raises(wf.ModelError, match=r"missing density of .*, required by gravity") as told:
        builder(None, gravity=(0, 0, -9.81))[0].finalize(device="cpu")
    assert "gravity=(0, 0, 0)" not in str(told.value)


def test_a_builder_makes_what_was_said_so_far():
    b, body = builder()
    models = [b.finalize(device="cpu")]
    b.add_traction(body.surface("x+"), (0, 0, 1.0))
    models.append(b.finalize(device="cpu"))
    moved = []
    for model in models:
        sim = wf.Simulation(model, dt=1e-3)
        sim.step()
        moved.append(np.abs(sim.displacements(body)).max())
    assert moved[0] == 0.0 < moved[1]


def test_a_file_that_is_no_stage_cannot_be_continued(tmp_path):
    path = tmp_path / "o.usdc"
    path.write_text("junk")
    sim = wf.Simulation(builder()[0].finalize(device="cpu"), dt=1e-3)
    with pytest.raises(OutputError, match="can't be read or continued"):
        wf.USDWriter(path, extend=True).open(sim)
    assert path.read_text() == "junk"


def test_measuring_launches_is_quiet(capfd):
    assert _empty_launch_seconds("cpu") > 0.0
    assert capfd.readouterr().out == ""
