"""Writers against a stub simulation: what they share, errors, clean-up."""

from __future__ import annotations

import os
import pathlib
import subprocess
import sys

import numpy as np
import pytest
from stub_simulation import FAR, StubSim, left_over, tet_box

from warpfea.base.errors import ModelError, OutputError
from warpfea.outputs.colormap import COLOR_TABLE, map_colors, to_linear, to_srgb
from warpfea.outputs.frames import FrameClock, grid_offsets
from warpfea.outputs.normals import vertex_normals
from warpfea.outputs.render import GIFWriter, PNGWriter
from warpfea.outputs.usd import USDWriter, validate_usd
from warpfea.outputs.vtk import VTUWriter

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
    assert coarse.time_code(0.04) == 4.0
    assert coarse.time_code(0.045) == pytest.approx(4.5)
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
    linear = to_linear(COLOR_TABLE)
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
    assert np.abs(to_srgb(linear) - COLOR_TABLE).max() < 1e-12
    colors = map_colors([-1.0, 0.0, 5.0, 10.0, 11.0, np.nan], 0.0, 10.0)
    assert np.allclose(colors[[0, 1]], COLOR_TABLE[0])
    assert np.allclose(colors[[3, 4]], COLOR_TABLE[-1])
    assert np.allclose(colors[2], COLOR_TABLE[16])
    assert np.allclose(colors[5], 0.5)
    assert np.allclose(map_colors([3.0, 4.0], 3.0, 3.0), COLOR_TABLE[0])


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
    for writer in (USDWriter(tmp_path / "o.obj"), PNGWriter(tmp_path / "o.gif"), GIFWriter(tmp_path / "o.png")):
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
