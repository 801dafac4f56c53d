"""Writers against a stub simulation: USD, VTU, PNG, GIF, the ray caster and the colour map."""

from __future__ import annotations

import itertools
import os
import pathlib
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from types import SimpleNamespace

import numpy as np
import pytest

from warpfea.base.errors import ModelError, OutputError
from warpfea.outputs.colormap import TABLE, map_colors, to_linear, to_srgb
from warpfea.outputs.frames import FrameClock, Surface, grid_offsets
from warpfea.outputs.normals import smooth_corners, vertex_normals
from warpfea.outputs.raycaster import Camera, Renderer, nice_number
from warpfea.outputs.render import GIFWriter, PNGWriter, render_usd
from warpfea.outputs.usd import USDWriter, validate_usd
from warpfea.outputs.vtk import VTUWriter

FAR = np.array([1.0e4, -2.0e4, 3.0e3])


# ------------------------------------------------------------------------------------------------ stub


def tet_box(size, cells):
    """Points (N, 3), tetra (M, 4) and outward surface triangles (T, 3) of a box cut into 6 tets per cell."""
    n = np.asarray(cells)
    grid = np.stack(np.meshgrid(*[np.arange(k + 1) for k in n], indexing="ij"), -1).reshape(-1, 3)
    number = {tuple(g): i for i, g in enumerate(grid)}
    tets = []
    for base in itertools.product(*[range(k) for k in n]):
        for order in itertools.permutations(range(3)):
            corner = [np.array(base)]
            for axis in order:
                corner.append(corner[-1] + np.eye(3, dtype=int)[axis])
            tet = [number[tuple(c)] for c in corner]
            d = np.linalg.det(np.array(corner[1:]) - corner[0])
            tets.append(tet if d > 0 else [tet[0], tet[2], tet[1], tet[3]])
    tets = np.array(tets)
    faces = np.concatenate([tets[:, f] for f in ([0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2])])
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return grid * (np.asarray(size) / n), tets, faces[first[count == 1]]


def quadratic(points, tets):
    """The same tets with mid-edge nodes in meshio's order."""
    pairs = [(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]
    edges = np.sort(np.stack([tets[:, p] for p in pairs], axis=1).reshape(-1, 2), axis=1)
    unique, where = np.unique(edges, axis=0, return_inverse=True)
    mids = points[unique].mean(axis=1)
    return np.concatenate([points, mids]), np.hstack([tets, where.reshape(-1, 6) + len(points)])


def body(name, size, cells, shift, order=1):
    points, tets, faces = tet_box(size, cells)
    used = np.unique(faces)  # skin points are a selection of the nodes, in another order
    skin = SimpleNamespace(triangles=np.searchsorted(used, faces), nodes=used)
    kind = "tetra"
    if order == 2:
        points, tets = quadratic(points, tets)
        kind = "tetra10"
    mesh = SimpleNamespace(
        points=points + shift, cells=tets, cell_type=kind, element_sets={"half": np.arange(len(tets) // 2)}
    )
    return SimpleNamespace(name=name, skin=skin, mesh=mesh)


class StubSim:
    """Two bodies, B worlds: a bar that twists at a rate of its world, a box that falls 1e4 m away."""

    def __init__(self, worlds=3, dt=0.01, up_axis="Z", far=FAR):
        self.dt = dt
        self.worlds = worlds
        self.bodies = [
            body("bar", (1.0, 0.2, 0.2), (8, 2, 2), np.zeros(3), order=2),
            body("2nd box", (0.3, 0.3, 0.3), (2, 2, 2), np.asarray(far)),
        ]
        self.model = SimpleNamespace(bodies=self.bodies, worlds=worlds, up_axis=up_axis)
        self.time = np.zeros(worlds)
        self.spoil = None

    def step(self):
        self.time = self.time + self.dt

    def positions(self, body):
        X = body.mesh.points
        out = np.repeat(X[None], self.worlds, axis=0)
        for world in range(self.worlds):
            t = self.time[world]
            if body.name == "bar":
                angle = (world + 1.0) * t * 3.0 * X[:, 0]
                y, z = X[:, 1] - 0.1, X[:, 2] - 0.1
                out[world, :, 1] = 0.1 + np.cos(angle) * y - np.sin(angle) * z
                out[world, :, 2] = 0.1 + np.sin(angle) * y + np.cos(angle) * z
            else:
                out[world, :, 2] -= 0.5 * (1.0 + world) * t**2
        if self.spoil is not None:
            out[self.spoil] = np.nan
        return out

    def displacements(self, body):
        return self.positions(body) - body.mesh.points

    def velocities(self, body):
        return np.ones_like(self.positions(body))

    def field(self, name, body):
        if name == "displacement":
            return np.linalg.norm(self.displacements(body), axis=2)
        return 1e6 * (body.mesh.points[:, 0] - body.mesh.points[:, 0].min() + self.time[:, None])

    def skin_points(self, body):
        return self.positions(body)[:, body.skin.nodes]

    def skin_field(self, name, body):
        return self.field(name, body)[:, body.skin.nodes]


def drive(sim, writer, steps, watch=None):
    writer.open(sim)
    writer.write(sim)
    if watch:
        watch(sim)
    for _ in range(steps):
        sim.step()
        writer.write(sim)
        if watch:
            watch(sim)
    writer.close(sim)


def left_over(folder):
    return sorted(p.name for p in pathlib.Path(folder).iterdir())


# ------------------------------------------------------------------------------------------- shared parts


def test_frame_clock():
    clock = FrameClock(10.0)
    times = np.arange(0, 101) * 0.03
    due = [t for t in times if clock.due(float(t))]
    assert len(due) == 31
    for k, t in enumerate(due):  # frame k: the first state at or after k / fps
        assert k / 10 - 1e-9 <= t < k / 10 + 0.03
    coarse = FrameClock(100.0)
    assert [coarse.due(t) for t in (0.0, 0.035, 0.036, 0.0399, 0.04)] == [True, True, False, False, True]
    assert coarse.code(0.04) == 4.0
    assert coarse.code(0.045) == pytest.approx(4.5)
    for bad in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(ModelError, match="frames per second"):
            FrameClock(bad)


def test_grid_offsets_and_normals():
    offsets = grid_offsets(7, (2.0, 3.0), "Z")
    assert len({tuple(o) for o in offsets}) == 7
    assert (offsets[0] == 0).all()
    assert (offsets[:, 2] == 0).all()
    assert (grid_offsets(7, (2.0, 3.0), "Y")[:, 1] == 0).all()
    points, _, triangles = tet_box((1, 1, 1), (3, 3, 3))
    normals = vertex_normals(points + FAR, triangles)
    middle = np.isclose(points, 0.5, atol=0.2).sum(axis=1) == 2  # inside a face of the box
    outward = np.sign(points - 0.5) * (np.abs(points - 0.5) > 0.4)
    on_skin = np.isin(np.arange(len(points)), triangles) & middle
    assert on_skin.sum() == 24
    assert np.abs(normals[on_skin] - outward[on_skin]).max() < 1e-6
    assert np.abs(np.linalg.norm(normals, axis=1) - 1).max() < 1e-6


def test_colormap_is_even():
    linear = to_linear(TABLE)
    light = 116 * np.cbrt(linear @ [0.2126, 0.7152, 0.0722]) - 16
    assert np.diff(light).min() > 1.9
    assert np.diff(light).max() < 2.8
    to_lms = [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
    to_lab = [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
    lab = np.cbrt(linear @ np.transpose(to_lms)) @ np.transpose(to_lab)
    distance = np.linalg.norm(np.diff(lab, axis=0), axis=1)
    assert np.abs(distance / distance.mean() - 1.0).max() < 0.15
    assert np.abs(to_srgb(linear) - TABLE).max() < 1e-12
    colors = map_colors([-1.0, 0.0, 5.0, 10.0, 11.0, np.nan], 0.0, 10.0)
    assert np.allclose(colors[[0, 1]], TABLE[0])
    assert np.allclose(colors[[3, 4]], TABLE[-1])
    assert np.allclose(colors[2], TABLE[16])
    assert np.allclose(colors[5], 0.5)
    assert np.allclose(map_colors([3.0, 4.0], 3.0, 3.0), TABLE[0])


# ---------------------------------------------------------------------------------------------------- USD


@pytest.fixture(scope="module")
def usd_run(tmp_path_factory):
    """A run of 3 worlds, 50 steps of 0.01 s, written at 30 frames per second, with all states remembered."""
    path = tmp_path_factory.mktemp("usd") / "o.usdc"
    sim = StubSim()
    seen = []
    writer = USDWriter(path, fps=30, fields=["von_mises", "displacement"])
    drive(sim, writer, 50, lambda s: seen.append((s.time[0], [s.skin_points(b) for b in s.bodies])))
    return SimpleNamespace(path=path, sim=sim, seen=seen, offsets=Surface(StubSim()).offsets)


def meshes_of(stage):
    from pxr import UsdGeom

    return [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]


def in_world(mesh, code):
    from pxr import UsdGeom

    matrix = np.array(UsdGeom.XformCache(code).GetLocalToWorldTransform(mesh.GetPrim()))
    return np.asarray(mesh.GetPointsAttr().Get(code), dtype=np.float64) @ matrix[:3, :3] + matrix[3, :3]


def test_usd_points_equal_the_simulation(usd_run):
    from pxr import Usd

    stage = Usd.Stage.Open(str(usd_run.path))
    meshes = meshes_of(stage)
    assert len(meshes) == 6
    assert len(left_over(usd_run.path.parent)) == 1
    codes = meshes[0].GetPointsAttr().GetTimeSamples()
    assert len(codes) == 16
    times = np.array([time for time, _ in usd_run.seen])
    for code in (codes[0], codes[7], codes[-1]):
        k = int(np.argmin(np.abs(times - code / 30.0)))
        assert abs(times[k] - code / 30.0) < 1e-9
        for world in range(3):
            for b in range(2):
                got = in_world(meshes[2 * world + b], code) - usd_run.offsets[world]
                want = usd_run.seen[k][1][b][world]
                assert np.abs(got - want).max() < 1e-7  # also 2.2e4 m from the origin


def test_usd_is_valid_and_complete(usd_run):
    from pxr import Usd, UsdGeom, UsdPhysics

    assert validate_usd(usd_run.path) == []
    stage = Usd.Stage.Open(str(usd_run.path))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert UsdPhysics.GetStageKilogramsPerUnit(stage) == 1.0
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, 15.0)
    assert stage.GetDefaultPrim().GetName() == "World"
    assert UsdGeom.Camera(stage.GetPrimAtPath("/World/Camera"))
    about = stage.GetDefaultPrim().GetCustomDataByKey("warpfea")
    assert about["schema"] == 1
    assert about["dt"] == 0.01
    assert about["fields"]["von_mises"]["units"] == "Pa"
    assert np.allclose(about["colorRange"], (0.0, 1.5e6))
    bodies = [m.GetPrim().GetParent() for m in meshes_of(stage)[:2]]
    assert [b.GetName() for b in bodies] == ["bar", "_nd_box"]
    assert bodies[1].GetDisplayName() == "2nd box"


def test_usd_meshes(usd_run):
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(usd_run.path))
    for mesh in meshes_of(stage):
        assert mesh.GetSubdivisionSchemeAttr().Get() == "none"
        assert mesh.GetOrientationAttr().Get() == "rightHanded"
        assert mesh.GetNormalsInterpolation() == "vertex"
        assert not mesh.GetFaceVertexIndicesAttr().GetTimeSamples()
        triangles = np.asarray(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
        codes = mesh.GetPointsAttr().GetTimeSamples()
        colors = mesh.GetDisplayColorPrimvar()
        stress = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("von_mises")
        for attribute in (mesh.GetNormalsAttr(), mesh.GetExtentAttr(), colors.GetAttr(), stress.GetAttr()):
            assert attribute.GetTimeSamples() == codes
        for code in (codes[0], codes[-1]):
            points = np.asarray(mesh.GetPointsAttr().Get(code), dtype=np.float64)
            assert triangles.min() == 0
            assert triangles.max() == len(points) - 1
            corner = points[triangles]
            area = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
            assert np.einsum("ij,ij->", corner[:, 0], area) / 6 > 0.01  # volume: triangles are outward
            normals = np.asarray(mesh.GetNormalsAttr().Get(code), dtype=np.float64)
            assert np.abs(np.linalg.norm(normals, axis=1) - 1).max() < 1e-6
            assert (np.einsum("tkj,tj->tk", normals[triangles], area) > 0).all()
            low, high = np.asarray(mesh.GetExtentAttr().Get(code))
            assert ((points >= low) & (points <= high)).all()
            values, color = np.asarray(stress.Get(code)), np.asarray(colors.Get(code))
            assert colors.GetInterpolation() == "vertex"
            assert np.allclose(color, map_colors(values, 0.0, 1.5e6, linear=True), atol=1e-6)
            assert len(np.unique(color, axis=0)) > 2
        early, late = colors.Get(codes[0]), colors.Get(codes[-1])
        assert np.abs(np.asarray(early) - np.asarray(late)).max() > 0.1


@pytest.mark.parametrize("suffix", [".usda", ".usd"])
def test_usd_interrupted_run_is_valid(tmp_path, suffix):
    """Closing early, between frames: the last state is there, at its own time."""
    from pxr import Usd

    path = tmp_path / f"o{suffix}"
    path.write_text("an older file")
    sim = StubSim(worlds=1, up_axis="Y")
    writer = USDWriter(path, fps=20, fields=[], color=None)
    writer.open(sim)
    assert path.read_text() == "an older file"
    writer.write(sim)
    for _ in range(8):
        sim.step()
        writer.write(sim)
    writer.close(sim)
    assert left_over(tmp_path) == [path.name]
    assert validate_usd(path) == []
    stage = Usd.Stage.Open(str(path))
    assert stage.GetEndTimeCode() == pytest.approx(1.6)
    mesh = meshes_of(stage)[0]
    assert mesh.GetPointsAttr().GetTimeSamples() == pytest.approx([0.0, 1.0, 1.6])
    assert np.abs(in_world(mesh, stage.GetEndTimeCode()) - sim.skin_points(sim.bodies[0])[0]).max() < 1e-7


def test_usd_large_runs_go_to_disk(tmp_path, monkeypatch):
    """Saving in between gives the same file content as saving once."""
    from pxr import Usd

    import warpfea.outputs.usd

    for name, limit in (("one.usdc", 1 << 40), ("many.usdc", 1 << 10)):
        monkeypatch.setattr(warpfea.outputs.usd, "_SAVE_BYTES", limit)
        drive(StubSim(worlds=2), USDWriter(tmp_path / name, fps=50), 10)
    stages = [Usd.Stage.Open(str(tmp_path / name)) for name in ("one.usdc", "many.usdc")]
    texts = [stage.GetRootLayer().ExportToString() for stage in stages]
    assert texts[0].splitlines()[2:] == texts[1].splitlines()[2:]


def test_usd_validator_sees_planted_defects(tmp_path, usd_run):
    from pxr import Usd, Vt

    def defect(change):
        path = tmp_path / f"{change.__name__}.usda"
        stage = Usd.Stage.Open(str(usd_run.path))
        stage.Export(str(path))
        stage = Usd.Stage.Open(str(path))
        change(stage, meshes_of(stage)[0])
        stage.GetRootLayer().Save()
        return " ".join(validate_usd(path))

    def index(stage, mesh):
        indices = mesh.GetFaceVertexIndicesAttr().Get()
        mesh.GetFaceVertexIndicesAttr().Set(Vt.IntArray([10**6, *indices[1:]]))

    def nan(stage, mesh):
        points = np.asarray(mesh.GetPointsAttr().Get(0.0)).copy()
        points[0] = np.nan
        mesh.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(points), 0.0)

    def extent(stage, mesh):
        mesh.GetExtentAttr().Set(Vt.Vec3fArray([(0, 0, 0), (0, 0, 0)]), 0.0)

    def units(stage, mesh):
        stage.ClearMetadata("metersPerUnit")

    def colors(stage, mesh):
        mesh.GetDisplayColorPrimvar().Set(Vt.Vec3fArray([(0, 0, 0)]), 0.0)

    def nested(stage, mesh):
        stage.DefinePrim(mesh.GetPath().AppendChild("inner"), "Mesh")

    assert "out of range" in defect(index)
    assert "not finite" in defect(nan)
    assert "extent" in defect(extent)
    assert "metersPerUnit" in defect(units)
    assert "displayColor has 1 values" in defect(colors)
    assert "Gprim" in defect(nested)
    assert "can't be opened" in validate_usd(tmp_path / "none.usdc")[0]


# ---------------------------------------------------------------------------------------------------- VTU


def test_vtu_series(tmp_path):
    import meshio

    sim = StubSim(worlds=2, dt=0.1)
    before = [b.mesh.cells.copy() for b in sim.bodies]
    writer = VTUWriter(tmp_path / "out", every=2, fields=["von_mises"])
    states = []
    drive(sim, writer, 5, lambda s: states.append((s.time[0], [s.positions(b) for b in s.bodies])))
    entries = [e.attrib for e in ElementTree.parse(writer.series).iter("DataSet")]
    assert writer.series == tmp_path / "out" / "out.pvd"
    assert sorted({float(e["timestep"]) for e in entries}) == [states[k][0] for k in (0, 2, 4, 5)]
    assert len(entries) == 4 * 2 * 2
    assert {e["part"] for e in entries} == {"0", "1", "2", "3"}
    assert left_over(tmp_path / "out") == sorted([*(e["file"] for e in entries), "out.pvd"])
    for entry in entries:
        time, part = float(entry["timestep"]), int(entry["part"])
        mesh = meshio.read(tmp_path / "out" / entry["file"])
        source = sim.bodies[part // 2]
        state = next(s for t, s in states if t == time)
        assert (mesh.points == state[part // 2][part % 2]).all()
        assert mesh.cells[0].type == source.mesh.cell_type
        assert (mesh.cells[0].data == before[part // 2]).all()
        assert np.allclose(mesh.points - mesh.point_data["displacement"], source.mesh.points, atol=1e-11)
        assert mesh.point_data["velocity"].shape == mesh.points.shape
        assert mesh.point_data["von_mises"].shape == (len(mesh.points),)
        assert mesh.cell_data["set:half"][0].sum() == len(mesh.cells[0].data) // 2
    for b, cells in zip(sim.bodies, before):
        assert (b.mesh.cells == cells).all()


def test_vtu_by_time_and_abort(tmp_path):
    sim = StubSim(worlds=1)
    writer = VTUWriter(tmp_path / "v", fps=20)
    drive(sim, writer, 10)
    assert len(left_over(tmp_path / "v")) == 3 * 2 + 1
    again = VTUWriter(tmp_path / "w")
    again.open(sim)
    again.write(sim)
    again.abort()
    assert left_over(tmp_path) == ["v"]
    with pytest.raises(OutputError, match="not both"):
        VTUWriter(tmp_path / "v", every=2, fps=20)
    with pytest.raises(OutputError, match="at least 1"):
        VTUWriter(tmp_path / "v", every=0)


# ----------------------------------------------------------------------------------------------- pictures


def test_png_shows_the_scene(tmp_path):
    from PIL import Image

    path = tmp_path / "o.png"
    drive(StubSim(far=(0, 0.5, 0)), PNGWriter(path, size=(320, 180)), 20)
    assert left_over(tmp_path) == ["o.png"]
    image = np.asarray(Image.open(path))
    assert image.shape == (180, 320, 3)
    assert np.ptp(image.reshape(-1, 3).astype(int), axis=0).min() > 120
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 1000
    left = image[:, :250].reshape(-1, 3).astype(int)
    assert (left[:, 0] > left[:, 2] + 90).mean() > 0.005  # yellow, on bodies, not on the bar
    assert (left[:, 2] > left[:, 1] + 15).mean() > 0.01  # violet
    early = tmp_path / "early.png"
    drive(StubSim(far=(0, 0.5, 0)), PNGWriter(early, size=(320, 180), time=0.0, field=None, ground=False), 20)
    other = np.asarray(Image.open(early)).astype(int)
    assert np.abs(other - image).max() > 60
    assert (np.ptp(other, axis=2) > 60).sum() == 0  # grey body


def test_gif_frames_differ(tmp_path):
    from PIL import Image, ImageSequence

    path = tmp_path / "o.gif"
    sim = StubSim(worlds=1, dt=0.01, far=(0, 0.5, 0.3))
    drive(sim, GIFWriter(path, fps=10, size=(200, 120), progress=False), 35)
    with Image.open(path) as gif:
        assert gif.n_frames == 5
        frames = [np.asarray(f.convert("RGB")).astype(int) for f in ImageSequence.Iterator(gif)]
        durations = [f.info["duration"] for f in ImageSequence.Iterator(gif)]
    assert durations[:4] == [100, 100, 100, 50]
    for a, b in itertools.pairwise(frames):
        assert (np.abs(a - b).max(axis=2) > 40).sum() > 50
    assert np.abs(frames[0][:10, :50] - frames[-1][:10, :50]).max() == 0  # the background stands still
    short = GIFWriter(tmp_path / "s.gif", fps=50, speed=0.5, size=(64, 64), max_frames=6, progress=False)
    drive(StubSim(worlds=1), short, 35)
    with Image.open(tmp_path / "s.gif") as gif:
        assert 3 <= gif.n_frames <= 7


def test_render_usd(tmp_path, usd_run):
    from PIL import Image
    from pxr import Usd

    near = tmp_path / "near.usdc"
    drive(StubSim(worlds=2, far=(0, 0.5, 0)), USDWriter(near, fps=30), 20)
    picture, movie = tmp_path / "o.png", tmp_path / "o.gif"
    assert render_usd(near, picture, size=(160, 90)) == picture
    direct = tmp_path / "direct.png"
    drive(StubSim(worlds=2, far=(0, 0.5, 0)), PNGWriter(direct, size=(160, 90), color_range=(0, 1.2e6)), 20)
    a, b = (np.asarray(Image.open(p)).astype(int) for p in (picture, direct))
    assert np.abs(a - b).mean() < 1.0  # what the file holds is what the run drew
    render_usd(near, movie, size=(100, 60), fps=10, field="displacement", progress=False)
    with Image.open(movie) as gif:
        assert gif.n_frames == 3
    empty = Usd.Stage.CreateNew(str(tmp_path / "empty.usda"))
    empty.GetRootLayer().Save()
    (tmp_path / "text.usda").write_text("not usd")
    for source, out, text in (
        (tmp_path / "none.usdc", picture, "no such file"),
        (tmp_path / "empty.usda", picture, "no mesh"),
        (tmp_path / "text.usda", picture, "can't be read as USD"),
        (picture, movie, r"can't be read as USD \(it is no USD file\)"),
    ):
        with pytest.raises(ModelError, match=text):
            render_usd(source, out)
    for out, text in ((tmp_path / "o.jpeg", "must end in"), (tmp_path / "nowhere" / "o.png", "nowhere")):
        with pytest.raises(OutputError, match=text):
            render_usd(near, out)
    for options, text in (
        ({"field": "heat"}, "fields: displacement, von_mises"),
        ({"time": 7.0}, "outside 0"),
        ({"size": (0, 10)}, "pixels"),
        ({"view": (0, 95)}, "view"),
    ):
        with pytest.raises(ModelError, match=text):
            render_usd(near, picture, **options)


def test_renderer_far_from_the_origin():
    """A shift by 1e4 m changes no more than a few pixels at edges; refitting equals building anew."""
    points, _, triangles = tet_box((1.0, 0.2, 0.2), (8, 2, 2))
    colors = map_colors(points[:, 0], 0.0, 1.0)
    images = []
    for shift in (np.zeros(3), FAR):
        renderer = Renderer(triangles, ground=float(shift[2]))
        images.append(renderer.render(points + shift, colors, size=(240, 135)).astype(int))
    assert (np.abs(images[0] - images[1]).max(axis=2) > 8).mean() < 0.002
    bent = points + np.array([0, 0, 0.3]) * (points[:, :1] ** 2)
    camera = Camera.framing(points, aspect=240 / 135)
    refitted = renderer_pictures(Renderer(triangles, reference=points), [points, bent], colors, camera)[1]
    anew = renderer_pictures(Renderer(triangles, reference=points), [bent], colors, camera)[0]
    assert (refitted == anew).all()
    with pytest.raises(OutputError, match="finite"):
        Renderer(triangles).render(points * np.nan, colors)


def test_renderer_turns_y_up():
    points, _, triangles = tet_box((1.0, 0.2, 0.2), (8, 2, 2))
    colors = map_colors(points[:, 0], 0.0, 1.0)
    turned = np.stack([points[:, 0], points[:, 2], -points[:, 1]], axis=1)
    z_up = Renderer(triangles, ground=0.0).render(points, colors, size=(240, 135))
    y_up = Renderer(triangles, ground=0.0, up_axis="Y").render(turned, colors, size=(240, 135))
    assert (z_up == y_up).all()


def renderer_pictures(renderer, states, colors, camera):
    return [renderer.render(points, colors, camera, (240, 135)) for points in states]


def test_camera_frames_all_points():
    rng = np.random.default_rng(3)
    points = rng.normal(size=(500, 3)) * [5.0, 0.2, 1.0] + FAR
    for view in ((-65, 20), (10, 0), (120, 80), (0, 90), (45, -90), (30, 89.9)):
        camera = Camera.framing(points, view=view, margins=(0.05, 0.2, 0.1, 0.1))
        forward, right, up = camera.axes()
        local = points - camera.eye
        depth = local @ forward
        tangent = np.tan(np.radians(camera.fov / 2))
        x = (local @ right / depth / tangent / (16 / 9) + camera.center[0] + 1) / 2
        y = (local @ up / depth / tangent + camera.center[1] + 1) / 2
        assert (depth > 0).all()
        assert x.min() > 0.045
        assert x.max() < 0.805
        assert y.min() > 0.095
        assert y.max() < 0.905
        assert max(np.ptp(x) / 0.75, np.ptp(y) / 0.8) > 0.97
    for x, y, z in ((0.1, 0.05, 5.0), (5.0, 0.2, 1.0)):  # looked at along the longest side too
        box = np.array(list(itertools.product((-x, x), (-y, y), (-z, z))))
        for view in ((0, 90), (0, 89), (90, 0), (-65, 20)):
            camera = Camera.framing(box, view=view)
            forward, right, up = camera.axes()
            local = box - camera.eye
            tangent = np.tan(np.radians(camera.fov / 2)) * (local @ forward)
            assert np.abs(local @ right / tangent / (16 / 9) + camera.center[0]).max() < 0.881
            assert np.abs(local @ up / tangent + camera.center[1]).max() < 0.841
    assert [nice_number(x) for x in (1.0, 0.3, 49.0, 50.0)] == pytest.approx([1.0, 0.2, 20.0, 50.0])


def test_smooth_corners_keep_edges():
    points, _, triangles = tet_box((1, 1, 1), (2, 2, 2))
    group, count = smooth_corners(points, triangles)
    assert count == 6 * 9  # each of the six sides has its own normals
    assert len(group) == 3 * len(triangles)
    assert smooth_corners(points, triangles, angle=120.0)[1] == 26


# ----------------------------------------------------------------------------------------- errors, clean-up


def all_writers(folder):
    return [
        USDWriter(folder / "o.usdc"),
        PNGWriter(folder / "o.png"),
        GIFWriter(folder / "o.gif"),
        VTUWriter(folder / "vtu"),
    ]


def test_abort_leaves_nothing(tmp_path):
    for writer in all_writers(tmp_path):
        writer.abort()
        sim = StubSim(worlds=1)
        writer.open(sim)
        writer.write(sim)
        writer.abort()
        writer.close(sim)
        assert left_over(tmp_path) == []


def test_bad_targets(tmp_path):
    for writer in all_writers(tmp_path / "missing"):
        with pytest.raises(OutputError, match="missing"):
            writer.open(StubSim(worlds=1))
    (tmp_path / "file").write_text("")
    for writer in all_writers(tmp_path / "file"):
        with pytest.raises(OutputError, match="file"):
            writer.open(StubSim(worlds=1))
    for writer in (
        USDWriter(tmp_path / "o.obj"),
        PNGWriter(tmp_path / "o.gif"),
        GIFWriter(tmp_path / "o.png"),
    ):
        with pytest.raises(OutputError, match=r"must end in \."):
            writer.open(StubSim(worlds=1))
    with pytest.raises(OutputError, match="color_range"):
        USDWriter(tmp_path / "o.usdc", color_range=(1.0, 1.0))
    for bad in ((0, 10), 3, "ab", (100.5, 100), (100, 100, 100)):
        with pytest.raises(ModelError, match=r"size: .*pixels"):
            PNGWriter(tmp_path / "o.png", size=bad)
    for bad in (3, (1, 2, 3), "ab", (0, 91), (np.nan, 0)):
        with pytest.raises(ModelError, match="view"):
            PNGWriter(tmp_path / "o.png", view=bad)
    for bad in (60, 0, "x"):
        with pytest.raises(ModelError, match="50 frames"):
            GIFWriter(tmp_path / "o.gif", fps=bad)
    for options, text in (({"fps": "x"}, "fps"), ({"color": 3}, "color"), ({"fields": "von_mises"}, "fields")):
        with pytest.raises(ModelError, match=text):
            USDWriter(tmp_path / "o.usdc", **options)
    assert left_over(tmp_path) == ["file"]


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_folder_without_permission(tmp_path):
    tmp_path.chmod(0o500)
    for writer in all_writers(tmp_path):
        with pytest.raises(OutputError, match="not writable"):
            writer.open(StubSim(worlds=1))


def test_positions_that_are_not_finite(tmp_path):
    sim = StubSim(worlds=3)
    writer = USDWriter(tmp_path / "o.usdc")
    writer.open(sim)
    writer.write(sim)
    sim.spoil = 1
    sim.time += 1.0
    with pytest.raises(OutputError, match="'bar', world 1"):
        writer.write(sim)
    writer.close(sim)  # what came before is kept
    assert validate_usd(tmp_path / "o.usdc") == []
    movie = GIFWriter(tmp_path / "o.gif", size=(64, 64), progress=False)
    sim = StubSim(worlds=3)
    movie.open(sim)
    movie.write(sim)
    sim.spoil = 1
    sim.time += 1.0
    with pytest.raises(OutputError, match="'bar', world 1"):
        movie.write(sim)
    movie.close(sim)
    assert left_over(tmp_path) == ["o.gif", "o.usdc"]


def test_import_is_lazy():
    """Importing the writers loads neither USD, meshio nor Pillow."""
    code = (
        "import sys, warpfea.outputs.usd, warpfea.outputs.vtk, warpfea.outputs.render;"
        "assert not {'pxr', 'meshio', 'PIL', 'tqdm'} & set(sys.modules), 'loaded'"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=pathlib.Path(__file__).parent.parent)
    assert done.returncode == 0
