"""Meshes of CAD files by Gmsh: volumes of curved bodies, units, groups, quads, what is refused."""

import json
import pathlib
import sys

import numpy as np
import pytest
from cli_runs import run

import warpfea as wf
from warpfea.base.errors import MeshError
from warpfea.mesh import cad

SCENES = pathlib.Path(__file__).resolve().parent.parent / "scenes"
CYLINDER = 'SetFactory("OpenCASCADE");\nCylinder(1) = {0, 0, 0, 0, 0, 0.04, 0.01};\n'
SHEET = CYLINDER + "Delete { Volume{1}; Surface{2, 3}; }\n"


@pytest.fixture
def gmsh():
    """Gmsh, if it is installed and the libraries that it loads are."""
    try:
        import gmsh
    except (ImportError, OSError) as error:
        pytest.skip(f"extra cad: {error}")
    return gmsh


def saved(gmsh, path, script):
    """A shape as a CAD file in mm."""
    gmsh.initialize(readConfigFiles=False, interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setString("Geometry.OCCTargetUnit", "MM")  # Open CASCADE keeps that of the last file
        script(gmsh.model.occ)
        gmsh.model.occ.synchronize()
        with cad._printing_to_stderr():
            gmsh.write(str(path))
    finally:
        gmsh.finalize()
    return path


def test_second_order_stays_curved(gmsh, tmp_path):
    """The volume of a cylinder with nodes on its side converges with the square of that with straight edges."""
    (tmp_path / "cylinder.geo").write_text(CYLINDER)
    errors = {}
    for element in ("T4", "T10"):
        meshes = [wf.mesh.from_cad(tmp_path / "cylinder.geo", size=size, element=element) for size in (8e-3, 3e-3)]
        errors[element] = [1.0 - mesh.volume() / (np.pi * 0.01**2 * 0.04) for mesh in meshes]
    mesh = meshes[1]
    side = mesh.points[mesh.nodes("face_1")]
    assert np.abs(np.hypot(side[:, 0], side[:, 1]) - 0.01).max() < 1e-9  # middle nodes among them
    assert not mesh.straight_sided().all()
    assert errors["T4"][1] > 5e-3
    assert 0.0 < errors["T10"][1] < 1e-5
    straight, curved = (coarse / fine for coarse, fine in errors.values())
    assert curved == pytest.approx(straight**2, rel=0.1)


@pytest.mark.parametrize("end", ["step", "igs", "brep"])
def test_units_and_sides(gmsh, tmp_path, end):
    """STEP and IGES tell that they are in mm; flat sides have the names of the generators."""
    path = saved(gmsh, tmp_path / f"block.{end}", lambda occ: occ.addBox(0, 0, 0, 30, 20, 10))
    mesh = wf.mesh.from_cad(path, size=0.01, element="T4", scale=1e-3 if end == "brep" else 1.0)
    assert (mesh.name, mesh.path) == ("block", str(path))
    assert mesh.volume() == pytest.approx(6e-6, rel=1e-12)
    assert {"solid_1", "face_1", "face_6", "x-", "z+"} <= {*mesh.element_sets, *mesh.surface_sets}
    assert np.allclose(mesh.points[mesh.nodes("x+"), 0], 0.03)
    if end == "step":
        path.write_text(path.read_text().replace("SI_UNIT(.MILLI.,.METRE.)", "SI_UNIT(.CENTI.,.METRE.)"))
        assert wf.mesh.from_cad(path, size=0.1, element="T4").volume() == pytest.approx(6e-3, rel=1e-12)
    edges = mesh.points[mesh.cells[:, [0, 1]]]
    assert np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1).max() < 0.02


def test_solids_that_touch_share_their_nodes(gmsh, tmp_path):
    def two(occ):
        occ.addBox(0, 0, 0, 10, 10, 10)
        occ.addBox(10, 0, 0, 10, 10, 10)

    mesh = wf.mesh.from_cad(saved(gmsh, tmp_path / "two.step", two), size=5e-3, element="T4")
    left, right = (np.unique(mesh.cells[mesh.elements(f"solid_{k}")]) for k in (1, 2))
    assert len(np.intersect1d(left, right)) >= 9
    with pytest.raises(MeshError, match=r"two\.igs: can't be meshed by Gmsh \(.*overlapping facets"):
        wf.mesh.from_cad(saved(gmsh, tmp_path / "two.igs", two), size=5e-3)

    def on_plate(occ):
        occ.addCylinder(0, 0, 0, 0, 0, 40, 10)
        occ.addBox(-30, -30, 40, 60, 60, 5)

    with pytest.raises(MeshError, match=r"pin\.igs: 3 of its 9 faces enclose no solid"):
        wf.mesh.from_cad(saved(gmsh, tmp_path / "pin.igs", on_plate), size=5e-3)


def test_quads_of_a_surface(gmsh, tmp_path):
    """Recombined quads alone, with their nodes on the cylinder."""
    (tmp_path / "sheet.geo").write_text(SHEET)
    mesh = wf.mesh.from_cad(tmp_path / "sheet.geo", size=3e-3, element="quad")
    assert mesh.cell_type == "quad"
    assert np.abs(np.hypot(mesh.points[:, 0], mesh.points[:, 1]) - 0.01).max() < 1e-6
    assert mesh.volume() == pytest.approx(2 * np.pi * 0.01 * 0.04, rel=0.03)
    b = wf.ModelBuilder()
    b.add_shell(mesh, thickness=1e-3, material=wf.SVK(E=1e9, nu=0.3, density=1000.0))


def test_the_scene_of_a_geo_file_is_that_of_its_mesh(gmsh):
    """Groups of the file keep their names."""
    made, saved_mesh = wf.mesh.from_cad(SCENES / "hook.geo"), wf.mesh.read(SCENES / "hook.msh")
    assert made.volume() == pytest.approx(saved_mesh.volume(), rel=1e-4)
    assert set(made.surface_sets) == {"fixed", "pull"}


def test_a_shape_runs_from_the_command_line(gmsh, tmp_path, capfd):
    path = tmp_path / "bar.geo"
    path.write_text('SetFactory("OpenCASCADE");\nBox(1) = {0, 0, 0, 0.1, 0.02, 0.02};\n')
    words = [
        "run",
        str(path),
        "--material",
        "svk:E=1e7,nu=0",
        "--gravity",
        "0,0,0",
        "--device",
        "cpu",
        "--size",
        "0.05",
    ]
    words += ["--static", "--load-steps", "1", "--json", "-", "--clamp", "x-", "--traction", "x+:1e3,0,0"]
    code, out, _ = run(capfd, *words)
    assert code == 0
    assert json.loads(out)["probes"]["x+"]["displacement"][0] == pytest.approx(1e-5, rel=1e-3)


def test_what_is_refused(tmp_path, monkeypatch):
    cylinder = tmp_path / "cylinder.geo"
    cylinder.write_text(CYLINDER)
    (tmp_path / "part.step").write_text("nonsense")
    for given, text in (
        ({"path": tmp_path / "no.step", "size": 1.0}, r"no\.step: no such file"),
        ({"path": cylinder.parent, "size": 1.0}, "no such file"),
        ({"path": tmp_path / "part.step"}, r"give size=, .* \(--size 2e-3\)"),
        ({"path": tmp_path / "part.step", "size": -1.0}, "size, scale must be positive"),
        ({"path": cylinder, "element": "T5"}, "element = 'T5' must be one of 'T4', 'T10', 'quad'"),
    ):
        with pytest.raises(MeshError, match=text):
            wf.mesh.from_cad(**given)
    with pytest.raises(MeshError, match=r"wf\.mesh\.from_cad STEP"):
        wf.mesh.read(tmp_path / "part.step")
    monkeypatch.setitem(sys.modules, "gmsh", None)
    with pytest.raises(MeshError, match=r"pip install 'warpfea\[cad\]'"):
        wf.mesh.from_cad(cylinder, size=0.01)


def test_a_damaged_file_is_refused_and_gmsh_left(gmsh, tmp_path):
    (tmp_path / "part.step").write_text("nonsense")
    with pytest.raises(MeshError, match=r"part\.step: (can't be meshed by Gmsh|holds no closed solids)"):
        wf.mesh.from_cad(tmp_path / "part.step", size=1.0)
    assert not gmsh.isInitialized()
    gmsh.initialize(readConfigFiles=False, interruptible=False)
    try:
        with pytest.raises(MeshError, match=r"Gmsh is in use in this process; call gmsh\.finalize"):
            wf.mesh.from_cad(tmp_path / "part.step", size=1.0)
        assert gmsh.isInitialized()
    finally:
        gmsh.finalize()
