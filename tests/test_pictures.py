"""VTU, PNG and GIF against a stub simulation, and the ray caster."""

from __future__ import annotations

import itertools
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from stub_simulation import FAR, StubSim, drive, left_over, tet_box

from warpfea.base.errors import ModelError, OutputError
from warpfea.outputs.animation import to_palette
from warpfea.outputs.colormap import map_colors, to_linear
from warpfea.outputs.normals import smooth_corners
from warpfea.outputs.pixels import rasterize
from warpfea.outputs.raycaster import Camera, Renderer, nice_number
from warpfea.outputs.render import GIFWriter, PNGWriter
from warpfea.outputs.vtk import VTUWriter

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


def test_frames_of_a_gif_have_no_bands():
    """Means over squares of a slope miss it by one value everywhere; the nearest of colours that are 8 apart go up and
    down by 6."""
    from PIL import Image

    slope = np.repeat(np.linspace(64, 128, 512)[None, :, None], 64, axis=0).repeat(3, axis=2).round().astype(np.uint8)
    palette = Image.new("P", (1, 1))
    palette.putpalette(np.repeat(np.arange(0, 256, 8), 3).tolist())
    nearest = Image.fromarray(slope).quantize(palette=palette, dither=Image.Dither.NONE)
    errors = []
    for picture in (to_palette(slope, palette), nearest):
        off = np.asarray(picture.convert("RGB")).astype(float) - slope
        errors.append(np.ptp(off.reshape(8, 8, 64, 8, 3).mean(axis=(1, 3))))
    assert errors[0] < 0.5
    assert errors[1] > 5.0


def test_gif_frames_differ(tmp_path):
    from PIL import Image, ImageSequence

    path = tmp_path / "o.gif"
    sim = StubSim(worlds=1, dt=0.01, far=(0, 0.5, 0.3))
    drive(sim, GIFWriter(path, fps=10, speed=1.0, size=(200, 120), progress=False), 35)
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
    for ground in (None, -0.1):  # what stands still is kept, and is that of a new picture
        renderers = [Renderer(triangles, reference=points, ground=ground) for _ in range(2)]
        refitted = renderer_pictures(renderers[0], [points, points, bent], colors, camera)[2]
        assert (refitted == renderer_pictures(renderers[1], [bent], colors, camera)[0]).all()
    with pytest.raises(OutputError, match="finite"):
        Renderer(triangles).render(points * np.nan, colors)


def test_rasterized_faces_are_those_that_rays_meet():
    """Nearest of triangles at samples by their weights; a picture by it is that of rays, which sections need."""
    import warp as wp
    from warpfea.kernels.outputs import raycast

    random = np.random.default_rng(0)
    corners, triangles = random.uniform((-3, -2, 0), (15, 12, 1), (90, 3)), np.arange(90).reshape(-1, 3)
    cells, offsets = random.random((10, 12)) < 0.7, np.array([[0.1, 0.9], [0.5, 0.5]])
    found = rasterize(wp, raycast, corners, triangles, cells, offsets)
    rows, columns = np.nonzero(cells)
    at = np.stack([columns, rows], axis=1)[:, None] + offsets
    best, faces = np.zeros(at.shape[:2]), np.full(at.shape[:2], -1)
    for k, corner in enumerate(corners[triangles]):
        weights = np.linalg.solve(
            np.vstack([corner[:, :2].T, np.ones(3)]), np.dstack([at, np.ones(best.shape)])[..., None]
        )
        depth = np.where((weights >= 0.0).all(axis=(2, 3)), weights[..., 0] @ corner[:, 2], -1.0)
        best, faces = np.maximum(best, depth), np.where(depth > best, k, faces)
    assert (found == faces).all()
    assert (faces < 0).any()
    points, _, surface = tet_box((1.0, 0.2, 0.2), (8, 2, 2))
    pictures = [
        Renderer(surface, ground=-0.3, cut=cut).render(points, map_colors(points[:, 0], 0.0, 1.0)).astype(int)
        for cut in (None, np.array([1.0, 0.0, 0.0, 9.0]))
    ]
    assert np.abs(pictures[0] - pictures[1]).max() <= 2
    assert (pictures[0] != pictures[1]).mean() < 1e-3


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


# ------------------------------------------------------------------------------------ what is drawn beside


def bodies_picture(tmp_path, name="x.png", **options):
    """Picture of the last of a few states."""
    from PIL import Image

    path = tmp_path / name
    drive(StubSim(far=(0.2, 0.5, 0.0), worlds=1), PNGWriter(path, size=(240, 135), **options), 15)
    return np.asarray(Image.open(path)).astype(int)


def changed(a, b, limit=20):
    """Number of pixels that differ."""
    return int((np.abs(a - b).max(axis=2) > limit).sum())


def test_options_of_pictures_draw_what_they_say(tmp_path):
    plain = bodies_picture(tmp_path)
    assert np.ptp(plain[-1, 90:170], axis=0).max() <= 3  # the sky, no invented floor
    assert changed(plain, bodies_picture(tmp_path, ground=True), 4) > 3000
    edges = bodies_picture(tmp_path, edges=True)
    assert changed(plain, edges) > 300
    assert (edges.sum(axis=2) <= plain.sum(axis=2) + 30).mean() > 0.99  # lines are dark
    assert 200 < changed(plain, bodies_picture(tmp_path, undeformed=True), 10) < 20000
    assert changed(plain, bodies_picture(tmp_path, scale=0.0)) > 300
    for options in ({"axes": True}, {"extremes": True}, {"legend": True}):
        assert 20 < changed(plain, bodies_picture(tmp_path, **options)) < 2500, options
    without = bodies_picture(tmp_path, hide=["2nd box"])
    vivid = [int((np.ptp(image[:, :200], axis=2) > 60).sum()) for image in (plain, without)]
    assert vivid[1] != vivid[0] > 0
    half = bodies_picture(tmp_path, cut=("+x", 0.5))
    assert changed(plain, half) > 300
    nothing = bodies_picture(tmp_path, cut=("-y", 99.0))
    assert (np.ptp(nothing[:, :190], axis=2) > 60).sum() == 0
    near = [int((np.ptp(bodies_picture(tmp_path, zoom=zoom)[:, :190], axis=2) > 60).sum()) for zoom in (0.5, 1.0)]
    assert near[0] < 0.5 * near[1]


def test_long_names_and_extremes_at_the_border_stay_in_the_picture(tmp_path, monkeypatch):
    from PIL import Image, ImageDraw

    from warpfea.outputs.overlay import Overlay

    sim = StubSim(far=(0.2, 0.5, 0.0), worlds=1)
    sim.bodies[0].name, told = "n" * 300, []
    draw = Overlay.draw
    monkeypatch.setattr(Overlay, "draw", lambda self, *more: told.append(self) or draw(self, *more))
    drive(sim, PNGWriter(tmp_path / "x.png", size=(240, 135), legend=True), 3)
    assert sorted(len(text) for text, _, _ in told[0].texts) == [7, 40]
    for spacing in (1.0, 3.0):  # of several worlds names are drawn in the first one
        drive(StubSim(worlds=2), PNGWriter(tmp_path / "x.png", size=(64, 64), legend=True, spacing=spacing), 1)
    assert told[1].texts[0][1][0] - told[2].texts[0][1][0] == pytest.approx(1.0)
    camera = Camera.framing(np.eye(3), view=(0, 0), aspect=1.0)
    corner = next(p for p in np.linspace((0, -9, 0), (0, 9, 0), 999) if 60 < camera.project(p, (64, 64))[0] < 63)
    image = Image.new("RGB", (200, 64))
    draw(Overlay(texts=[("max 1 Pa", corner, True)]), ImageDraw.Draw(image), camera, (64, 64))
    assert not np.asarray(image)[:, 65:].any()


def square(height, low=0.0, high=1.0):
    """Points and triangles of a horizontal square, seen from above."""
    points = np.array([[low, low, height], [high, low, height], [high, high, height], [low, high, height]])
    return points, np.array([[0, 1, 2], [0, 2, 3]])


def test_transparent_surfaces_blend_in_their_order():
    """Behind a square of opacity 0.3 the light is 0.3 of its own and 0.7 of that behind, whichever comes first."""
    (low, triangles), (high, _) = square(0.0), square(0.5, 0.25, 0.75)
    points, both = np.concatenate([low, high]), np.concatenate([triangles, triangles + 4])
    colors = np.repeat([[0.8, 0.2, 0.2], [0.2, 0.3, 0.9]], 4, axis=0)
    camera = Camera.framing(points, view=(0, 89), aspect=1.0)

    def cast(rows, opacity=None, **options):
        renderer = Renderer(both[rows], opacity=opacity, **options)
        return to_linear(renderer.render(points, colors, camera, (64, 64)) / 255.0)[24:40, 24:40]

    below, above, solid = cast([0, 1]), cast([2, 3]), cast([0, 1, 2, 3])
    seen = cast([0, 1, 2, 3], np.array([1.0, 1.0, 0.3, 0.3]))
    assert np.abs(above - below).max() > 0.2
    assert np.abs(seen - (0.3 * above + 0.7 * below)).max() < 0.006
    assert np.abs(seen - cast([3, 2, 1, 0], np.array([0.3, 0.3, 1.0, 1.0]))).max() < 1e-6
    assert (cast([0, 1, 2, 3], np.ones(4)) == solid).all()
    assert np.abs(cast([0, 1, 2, 3], np.array([1.0, 1.0, 0.0, 0.0])) - below).max() < 1e-6  # nor a shadow


def test_obstacles_with_a_grid():
    """Dark lines at round coordinates of the surface, that move with it."""
    points, triangles = square(0.0)
    camera = Camera.framing(points, view=(0, 90), aspect=1.0)
    step = 0.5 * nice_number(0.2 * camera.size)
    colors = np.full((4, 3), 0.6)
    for shift in (0.0, 0.3 * step):
        moved = points + np.array([0.0, shift, 0.0])
        row = int(camera.project(np.array([0.5 + 0.5 * step, 0.5, 0.0]), (200, 200))[1])  # between lines
        pictures = [
            Renderer(triangles, reference=points, gridded=mask)
            .render(moved, colors, camera, (200, 200))[row, :, 0]
            .astype(int)
            for mask in (None, np.ones(2, dtype=bool))
        ]
        lines = [
            camera.project(np.array([0.5, k * step + shift, 0.0]), (200, 200))[0] for k in range(round(1 / step) + 1)
        ]
        dark = np.flatnonzero(pictures[0] - pictures[1] > 12)
        assert len(lines) >= 4
        assert max(np.abs(np.array(lines)[:, None] - dark - 0.5).min(axis=0)) < 2.0  # no other
        assert max(np.abs(np.array(lines[1:-1])[:, None] - dark - 0.5).min(axis=1)) < 2.0  # every one


def test_the_low_end_of_a_map_shows_form():
    """Lightness (CIELAB) over a box of the lowest value."""
    points, _, triangles = tet_box((1, 1, 1), (2, 2, 2))
    images, spread = {}, {}
    for name in ("viridis", "coolwarm"):
        colors = map_colors(np.zeros(len(points)), 0.0, 1.0, name)
        images[name] = to_linear(Renderer(triangles).render(points, colors, size=(96, 96)) / 255.0)
    inside = np.abs(images["coolwarm"] - images["viridis"]).max(axis=2) > 0.01
    assert inside.sum() > 500
    for name, image in images.items():
        light = 116.0 * np.cbrt(image[inside] @ (0.2126, 0.7152, 0.0722)) - 16.0
        spread[name] = np.ptp(np.percentile(light, (5, 95)))
    assert spread["coolwarm"] > 10.0 > spread["viridis"] > 0.0, spread


def test_bodies_seen_through_and_rigid_parts(tmp_path):
    plain = bodies_picture(tmp_path)
    through = bodies_picture(tmp_path, opacity={"bar": 0.4})
    assert changed(plain, through, 8) > 1000
    assert (bodies_picture(tmp_path, opacity={"bar": 0.0}) == bodies_picture(tmp_path, hide=["bar"])).mean() > 0.6
    assert changed(plain, bodies_picture(tmp_path, colors="coolwarm")) > 1000
    grey = bodies_picture(tmp_path, field=None)
    sim = StubSim(far=(0.2, 0.5, 0.0), worlds=1)
    for body in sim.bodies:
        body.rigid = True
    path = tmp_path / "rigid.png"
    drive(sim, PNGWriter(path, size=(240, 135)), 15)
    from PIL import Image

    rigid = np.asarray(Image.open(path)).astype(int)
    assert (np.ptp(grey[:, :190], axis=2) > 40).sum() == 0
    hues = [((rigid[..., a] - rigid[..., b])[:, :190] > 25).sum() for a, b in ((0, 2), (2, 0))]
    assert min(hues) > 300  # the bar is blue, the box brown, and there is no bar of colours


def test_camera_follows_and_ranges_are_chosen(tmp_path):
    followed = bodies_picture(tmp_path, follow="2nd box", field=None)
    at = bodies_picture(tmp_path, target=(0.35, 0.65, 0.15 - 0.5 * 0.15**2), field=None)
    assert changed(followed, at) < 60  # the box is at that place
    from warpfea.outputs.animation import Animation, Frame
    from warpfea.outputs.look import Look

    values = np.concatenate([np.arange(101.0), [1e9, np.nan]])
    film = Animation(np.array([[0, 1, 2]]), "Z", np.zeros((103, 3)), parts=[("a", 0, 51), ("b", 51, 52)])
    film.frames = [Frame(0.0, np.zeros((103, 3)), values)]
    assert film.color_limits(Look()) == (0.0, 1e9)
    assert film.color_limits(Look(range_body="a")) == (0.0, 50.0)
    low, high = film.color_limits(Look(percentile=(10, 90)))
    assert (low, high) == pytest.approx(tuple(np.percentile(values[:-1], (10, 90))))


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"marks": "support"}, "kinds of marks"),
        ({"marks": ("suport",)}, "did you mean 'support'"),
        ({"zoom": 0.0}, "zoom"),
        ({"cut": ("y", 0.0)}, "cut must be"),
        ({"cut": ("+y", np.nan)}, "cut must be"),
        ({"marks": None}, "kinds of marks"),
        ({"opacity": 0.3}, "numbers by name"),
        ({"hide": "bar"}, "hide must be names"),
        ({"hide": ["2nd box", "bar"]}, "hide leaves nothing to draw of bar, 2nd box"),
        ({"time": np.nan}, "time must be a finite"),
        ({"time": "1 s"}, "time must be a finite"),
        ({"opacity": {"bar": 1.5}}, "opacity of 'bar'"),
        ({"opacity": {"bat": 0.5}}, "there are bar, 2nd box"),
        ({"colors": "virides"}, "did you mean 'viridis'"),
        ({"percentile": (90, 10)}, "percentile"),
        ({"target": (0, 0)}, "target"),
        ({"hide": ["bar "]}, "there are bar, 2nd box"),
        ({"follow": "bat"}, "there are bar, 2nd box"),
    ],
)
def test_bad_options_of_pictures_are_refused(tmp_path, options, text):
    with pytest.raises(ModelError, match=text):
        PNGWriter(tmp_path / "x.png", **options).open(StubSim(worlds=1))


def test_gif_chooses_its_speed(tmp_path):
    from PIL import Image, ImageSequence

    writer = GIFWriter(tmp_path / "x.gif", fps=5, size=(64, 64), max_frames=20, progress=False)
    drive(StubSim(worlds=1), writer, 45)  # 0.45 s are shown in 3 s
    with Image.open(tmp_path / "x.gif") as gif:
        durations = [f.info["duration"] for f in ImageSequence.Iterator(gif)]
    assert 12 <= len(durations) <= 16
    assert sum(durations[:-1]) == pytest.approx(3000, abs=120)
