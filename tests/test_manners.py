"""First impressions of a new user: quiet, named errors, plausible sizes, names that are nearly right."""

from __future__ import annotations

import os
import pathlib
import subprocess
import sys
import warnings
from dataclasses import replace

import mesh_writers as writers
import numpy as np
import pytest
import warp as wp

import warpfea as wf
from warpfea.base.console import compile_progress_bar, quiet_warp
from warpfea.base.names import did_you_mean

ROOT = pathlib.Path(__file__).resolve().parent.parent
BOX = wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1))
GROUPED = replace(BOX, element_sets={"body": np.arange(len(BOX.cells))})
LAW = wf.SVK(E=1e7, nu=0.3, density=1000.0)
WEIGHTLESS = {
    "svk": wf.SVK(E=1e7, nu=0.3),
    "svk from E": wf.SVK.from_E_nu(E=1e7, nu=0.3),
    "neo_hookean": wf.NeoHookean(mu=4e6, k=1e7),
    "neo_hookean from E": wf.NeoHookean.from_E_nu(E=1e7, nu=0.3),
    "mooney_rivlin": wf.MooneyRivlin(mu10=3e6, mu01=1e6, k=1e7),
    "mooney_rivlin from E": wf.MooneyRivlin.from_E_nu(E=1e7, nu=0.3),
}


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


def python(code, **environment):
    """Run code in a fresh interpreter."""
    env = {**os.environ, "PYTHONPATH": str(ROOT), **environment}
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env)


# quiet

STEP = """
import warp as wp, warpfea as wf
{before}
b = wf.ModelBuilder()
body = b.add_solid(wf.mesh.box((1, .2, .2), cells=(2, 1, 1)), material=wf.SVK(E=1e7, nu=.3, density=1000.), name="bar")
b.clamp(body.nodes("x-"))
level = wp.config.log_level
model = b.finalize(device="cpu")
model.tangent_matrix(model.state())
sim = wf.Simulation(model, dt=1e-3)
sim.run(2e-3)
sim.field("von_mises", body)
assert wp.config.log_level == level, wp.config.log_level
"""


def test_a_simulation_prints_nothing_of_its_own():
    done = python(STEP.format(before=""))
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_who_asks_warp_for_more_gets_it():
    done = python(STEP.format(before="wp.config.log_level = wp.LOG_DEBUG"))
    assert done.returncode == 0, done.stderr
    assert "Warp" in done.stdout
    assert "Module warpfea." in done.stdout


def test_the_level_is_restored_after_an_error():
    before = wp.config.log_level
    wp.config.log_level = wp.LOG_INFO
    try:
        try:
            with quiet_warp():
                assert wp.config.log_level == wp.LOG_WARNING
                raise KeyError
        except KeyError:
            pass
        assert wp.config.log_level == wp.LOG_INFO
    finally:
        wp.config.log_level = before


def test_the_bar_of_the_compilation_is_shown_on_a_terminal_only(capfd, monkeypatch):
    model = bar()[0].finalize(device="cpu")
    capfd.readouterr()
    wf.Simulation(model, dt=1e-3)
    assert capfd.readouterr() == ("", "")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    wf.Simulation(model, dt=1e-3)
    out, err = capfd.readouterr()
    assert out == ""
    assert "compiling kernels" in err
    wf.Simulation(model, dt=1e-3, on_compile=lambda *_: None)  # who draws a bar of their own gets one only
    assert capfd.readouterr() == ("", "")
    with compile_progress_bar(False) as update:
        update(1, 2, "warpfea.kernels.x")
    assert capfd.readouterr() == ("", "")


# density


@pytest.mark.parametrize("law", WEIGHTLESS)
def test_a_material_has_no_density_unless_it_is_given(law):
    material = WEIGHTLESS[law]
    name = type(material).__name__
    assert material.density is None
    with pytest.raises(wf.ModelError, match=rf"'bar': missing density of {name}, required by gravity"):
        bar(material)[0].finalize(device="cpu")
    model = bar(material, gravity=(0, 0, 0))[0].finalize(device="cpu")
    with pytest.raises(wf.ModelError, match=rf"'bar': missing density of {name}, required by motion.*density="):
        wf.Simulation(model, dt=1e-3)


def test_statics_without_gravity_needs_no_density():
    given, missing = (
        wf.solve_static(bar(m, gravity=(0, 0, 0))[0].finalize(device="cpu"), load_steps=2)
        for m in (wf.SVK(E=1e7, nu=0.3, density=7850.0), wf.SVK(E=1e7, nu=0.3))
    )
    a, b = (r.probe("tip").displacement[0, -1] for r in (given, missing))
    assert a[2] < -1e-4
    np.testing.assert_allclose(b, a, rtol=1e-9, atol=1e-12)


def test_gravity_set_later_needs_a_density_too():
    b, body = bar(wf.SVK(E=1e7, nu=0.3), gravity=(0, 0, 0))
    model = b.finalize(device="cpu")

    def later():
        model.set_gravity((0, 0, -9.81))
        wf.solve_static(model)

    with pytest.raises(wf.ModelError, match=r"missing density of .*, required by gravity"):
        later()


def test_the_material_without_density_is_named_among_many():
    b = wf.ModelBuilder()
    b.add_solid(BOX, material=LAW, name="heavy")
    b.add_solid(GROUPED, material={"body": wf.NeoHookean(mu=1e6, k=1e7)}, name="light")
    with pytest.raises(wf.ModelError, match="'light': missing density of NeoHookean of group 'body'"):
        b.finalize(device="cpu")


def test_a_body_force_needs_a_density():
    @wp.func
    def pull(x: wp.vec3d, t: wp.float64) -> wp.vec3d:
        return wp.vec3d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0))

    b, body = bar(wf.SVK(E=1e7, nu=0.3), gravity=(0, 0, 0))
    b.add_body_force(pull, bodies=[body])
    with pytest.raises(wf.ModelError, match=r"'bar'.*missing density.*, required by add_body_force"):
        b.finalize(device="cpu")


# sizes


def written(tmp_path, mesh=BOX, drop=(), kind="msh22"):
    """A Gmsh file of a mesh, without the groups of some dimensions."""
    parts = writers.Parts.of(mesh)
    path = tmp_path / "part.msh"
    writers.write(parts, path, kind)
    return path, parts


def test_a_part_in_mm_read_as_m_warns_with_the_scale(tmp_path):
    path, _ = written(tmp_path, BOX.transformed(scale=50.0))  # 50 m x 10 m x 10 m of steel
    steel = wf.SVK(E=2e11, nu=0.3, density=7850.0)
    with pytest.warns(
        wf.MeshWarning, match=r"'bar' is 50 m long and weighs 3.9\de\+07 kg: .*part.msh is in mm.* scale=1e-3"
    ):
        bar(steel, mesh=str(path), clamp=False)[0].finalize(device="cpu")
    with warnings.catch_warnings():
        warnings.simplefilter("error", wf.MeshWarning)
        bar(steel, mesh=str(path), clamp=False, scale=1e-3)[0].finalize(device="cpu")


@pytest.mark.parametrize(
    ("scale", "density", "text"),
    [(2000.0, None, r"2e\+03 m long: lengths"), (1e-7, 1000.0, "1e-07 m long"), (1e-5, 10.0, r"weighs 4e-16 kg")],
)
def test_sizes_beyond_reason_warn(scale, density, text):
    material = wf.SVK(E=1e7, nu=0.3, density=density)
    with pytest.warns(wf.MeshWarning, match=text):
        bar(material, gravity=(0, 0, 0), mesh=BOX.transformed(scale=scale), clamp=False)[0].finalize(device="cpu")


@pytest.mark.parametrize("scale", [1e-3, 1.0, 30.0])
def test_sizes_within_reason_do_not(scale):
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        bar(LAW, mesh=BOX.transformed(scale=scale), clamp=False)[0].finalize(device="cpu")
    assert not [w for w in told if issubclass(w.category, wf.MeshWarning)]


# meshes


def as_meshio(mesh=BOX, **options):
    import meshio

    return meshio.Mesh(mesh.points, [(mesh.cell_type, mesh.cells)], **options)


def test_a_meshio_mesh_is_taken_as_it_is():
    sets = {"left": [BOX.elements(lambda X: X[:, 0] < 0.5)], "right": [BOX.elements(lambda X: X[:, 0] > 0.5)]}
    mesh = as_meshio(cell_sets=sets, point_sets={"held": BOX.nodes("x-")})
    b = wf.ModelBuilder()
    body = b.add_solid(mesh, material={"left": LAW, "right": LAW}, scale=2.0)
    assert body.mesh.path is None
    np.testing.assert_array_equal(body.mesh.points, 2.0 * BOX.points)
    np.testing.assert_array_equal(body.mesh.cells, BOX.cells)
    np.testing.assert_array_equal(body.nodes("held").indices, BOX.nodes("x-"))
    assert len(body.elements("left")) + len(body.elements("right")) == len(BOX.cells)
    quads = wf.mesh.grid((1, 1), cells=(2, 2))
    plate = b.add_shell(as_meshio(quads), thickness=0.1, material=LAW)
    assert len(plate.mesh.cells) == 4


def test_groups_of_gmsh_survive_meshio(tmp_path):
    import meshio

    path, _ = written(tmp_path)
    taken, read = wf.mesh.from_meshio(meshio.read(path)), wf.mesh.read(path)
    assert sorted(read.surface_sets) == sorted(taken.surface_sets)
    assert sorted(read.element_sets) == sorted(taken.element_sets)
    for name, faces in read.surface_sets.items():
        np.testing.assert_array_equal(taken.surface(name), faces)


def test_what_is_no_mesh_is_named_in_full():
    class Mesh:
        pass

    with pytest.raises(wf.ModelError, match=r"add_solid: mesh must be .* a meshio.Mesh, got .*Mesh"):
        wf.ModelBuilder().add_solid(Mesh(), material=LAW)
    with pytest.raises(wf.MeshError, match=r"expected a meshio.Mesh, got"):
        wf.mesh.from_meshio(Mesh())
    lost = as_meshio()
    lost.points = np.full_like(BOX.points, np.nan)
    with pytest.raises(wf.MeshError, match=r"meshio.Mesh: node 0"):
        wf.ModelBuilder().add_solid(lost, material=LAW)


def test_groups_of_surfaces_only_say_that_the_volume_has_none():
    text = r"'steel' is not .*volume has no group .*'x-'.*: give one material for the whole body, material=law"
    with pytest.raises(wf.ModelError, match=text + "$"):
        wf.ModelBuilder().add_solid(BOX, material={"steel": LAW})
    with pytest.raises(wf.ModelError, match=text + r", or name the volume in Gmsh, Physical Volume"):
        wf.ModelBuilder().add_solid(replace(BOX, path="part.msh"), material={"steel": LAW})
    with pytest.raises(wf.ModelError) as error:  # with groups of elements it is another mistake
        wf.ModelBuilder().add_solid(GROUPED, material={"boddy": LAW})
    assert "did you mean 'body'" in str(error.value)
    assert "volume" not in str(error.value)


def test_a_file_whose_volume_was_not_saved_says_why(tmp_path):
    import meshio

    triangles = BOX.faces("x-")[:, :3]
    path = tmp_path / "skin.msh"
    mesh = meshio.Mesh(
        BOX.points, [("triangle", triangles)],
        cell_data={"gmsh:physical": [np.full(len(triangles), 3)], "gmsh:geometrical": [np.full(len(triangles), 1)]},
        field_data={"wall": np.array([3, 2])},
    )  # fmt: skip
    meshio.write(path, mesh, file_format="gmsh22")
    with pytest.raises(wf.MeshError, match=r"no tetrahedra.*surfaces \('wall'\).*Physical Volume.*SaveAll"):
        wf.mesh.read(path)


def test_a_group_of_another_kind_is_said_so():
    with pytest.raises(wf.MeshError, match=r"no surface set named 'body'; .*'body' is a set of elements"):
        GROUPED.surface("body")
    with pytest.raises(wf.MeshError, match=r"no element set named 'x-'; there are: 'body'; 'x-' is a set of faces and"):
        GROUPED.elements("x-")


# names


@pytest.mark.parametrize(
    ("name", "known", "found"),
    [
        ("Von-Mises", ["von_mises", "displacement"], "; did you mean 'von_mises'?"),
        ("displacment", ["von_mises", "displacement"], "; did you mean 'displacement'?"),
        ("--materail", ["--material", "--clamp"], "; did you mean '--material'?"),
        ("top", ["x-", "x+"], ""),
        ("--foo", ["--tol", "--json"], ""),
        ("rnu", ["run", "info"], "; did you mean 'run'?"),
        ("a", [], ""),
        (3, ["4"], ""),
    ],
)
def test_did_you_mean(name, known, found):
    assert did_you_mean(name, known) == found


def test_names_that_are_nearly_right_are_offered():
    sim = simulation()
    body = sim.model.bodies[0]
    cases = {
        "tip": lambda: sim.probe("tpi"),
        "von_mises": lambda: sim.field("vonmises", body),
        "displacement": lambda: sim.skin_field("displacements", body),
        "revolute": lambda: wf.ModelBuilder().add_joint("revolut", parent=wf.GROUND, child=body.nodes("x-")),
        "tied": lambda: wf.ModelBuilder().add_beam(
            [(0, 0, 0), (1, 0, 0)], elements=1, section=wf.Rectangle(0.1, 0.1), normal=(0, 0, 1), material=LAW,
            integration="tyed"),
    }  # fmt: skip
    for meant, action in cases.items():
        if meant == "revolute":
            b, own = bar()
            action = lambda b=b, own=own: b.add_joint("revolut", parent=wf.GROUND, child=own.nodes("x-"))  # noqa: E731
        with pytest.raises(wf.ModelError, match=f"did you mean '{meant}'"):
            action()
