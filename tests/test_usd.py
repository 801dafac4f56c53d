"""The USD writer against a stub simulation, and pictures of its files."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from stub_simulation import StubSim, drive, left_over

from warpfea.base.errors import ModelError, OutputError
from warpfea.outputs.colormap import map_colors
from warpfea.outputs.frames import DrawnSurface
from warpfea.outputs.render import PNGWriter, render_usd
from warpfea.outputs.usd import USDWriter, validate_usd

# ---------------------------------------------------------------------------------------------------- USD


@pytest.fixture(scope="module")
def usd_run(tmp_path_factory):
    """A run of 3 worlds, 50 steps of 0.01 s, written at 30 frames per second, with all states remembered."""
    path = tmp_path_factory.mktemp("usd") / "o.usdc"
    sim = StubSim()
    seen = []
    writer = USDWriter(path, fps=30, fields=["von_mises", "displacement"])
    drive(sim, writer, 50, lambda s: seen.append((s.time[0], [s.skin_points(b) for b in s.bodies])))
    return SimpleNamespace(path=path, sim=sim, seen=seen, offsets=DrawnSurface(StubSim()).offsets)


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
        corners = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals")  # both bodies have sharp edges
        assert corners.GetInterpolation() == "faceVarying"
        assert not mesh.GetFaceVertexIndicesAttr().GetTimeSamples()
        triangles = np.asarray(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
        codes = mesh.GetPointsAttr().GetTimeSamples()
        colors = mesh.GetDisplayColorPrimvar()
        stress = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("von_mises")
        for attribute in (corners.GetAttr(), mesh.GetExtentAttr(), colors.GetAttr(), stress.GetAttr()):
            assert attribute.GetTimeSamples() == codes
        for code in (codes[0], codes[-1]):
            points = np.asarray(mesh.GetPointsAttr().Get(code), dtype=np.float64)
            assert triangles.min() == 0
            assert triangles.max() == len(points) - 1
            corner = points[triangles]
            area = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
            assert np.einsum("ij,ij->", corner[:, 0], area) / 6 > 0.01  # volume: triangles are outward
            normals = np.asarray(corners.ComputeFlattened(code), dtype=np.float64).reshape(-1, 3, 3)
            assert np.abs(np.linalg.norm(normals, axis=2) - 1).max() < 1e-6
            lean = np.einsum("tkj,tj->tk", normals, area) / np.linalg.norm(area, axis=1)[:, None]
            assert lean.min() > 0.8  # of its own side, not of three: 0.58
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


# ----------------------------------------------------------------------------------------------- pictures


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


def test_usd_material_reads_the_color_and_the_layer_says_how_it_was_made(tmp_path):
    from pxr import Usd, UsdShade

    path = tmp_path / "m.usdc"
    sim = StubSim(worlds=2)
    drive(sim, USDWriter(path, fps=20, layer_data={"command": "warpfea run x", "seed": 7}), 5)
    assert validate_usd(path) == []
    stage = Usd.Stage.Open(str(path))
    for mesh in meshes_of(stage):
        material, _ = UsdShade.MaterialBindingAPI(mesh.GetPrim()).ComputeBoundMaterial()
        shader = material.ComputeSurfaceSource()[0]
        assert shader.GetIdAttr().Get() == "UsdPreviewSurface"
        source = shader.GetInput("diffuseColor").GetConnectedSources()[0][0].source
        assert UsdShade.Shader(source.GetPrim()).GetInput("varname").Get() == "displayColor"
    kept = stage.GetRootLayer().customLayerData["warpfea"]
    assert (kept["command"], kept["seed"]) == ("warpfea run x", "7")
    assert {"warpfea", "warp", "numpy"} <= set(kept["versions"])
    assert kept["units"].startswith("SI")
