"""Pages beside the ray caster, and their sizes: tests/results/html_cpu.json.

`python tests/page_bars.py --out tests/results/html_cpu.json`, from the root of a checkout, with Debian's chromium and
playwright: minutes on two cores.

pictures    20 frames of each of ten scenes, bodies alone, 480 x 300, with the same camera: overlap, common pixels over
            the pixels of either (least of the frames), by pixels' middles, and the mean difference of colours inside,
            of 255 (largest of the frames)
size        10 000 points of a bent and twisted bar, 60 frames, one field: MB of the page, seconds until it is drawn
"""

from __future__ import annotations

import argparse
import pathlib
import sys
import tempfile
from typing import Any

import numpy as np
from browser import Tab, open_browser

import warpfea as wf
from warpfea.base.console import quiet_warp, to_json, write_json
from warpfea.base.provenance import provenance_of
from warpfea.builder.scene import find
from warpfea.outputs.colormap import map_colors
from warpfea.outputs.html import HTMLWriter
from warpfea.outputs.page import Page, PageSurface
from warpfea.outputs.raycaster import Camera, Renderer, to_z_up

SIZE, FRAMES = (480, 300), 20
SCENES = {
    "hook": 0.1, "cantilever": 0.4, "twist": 0.4, "four_bar": 0.1, "bouncing_ball": 0.3, "rollup": 0.4, "pendulum": 0.4,
    "plate_pendulum": 0.3, "double_pendulum": 0.3, "arch": 0.2,
}  # fmt: skip
"""Ends of the runs, s, of the scenes."""


class Kept(HTMLWriter):
    """Keeps the page that it writes."""

    def page(self, sim: Any) -> Page:
        self.kept = super().page(sim)
        return self.kept


def written(name: str, t_end: float, path: pathlib.Path) -> Page:
    """Page of a scene with 20 frames, written to `path`."""
    scene = find(name)
    sim = wf.Simulation(
        scene().finalize(device="cpu"), dt=scene.dt, integrator=scene.integrator, solver=wf.NewtonPCG(tol=scene.tol)
    )
    out = Kept(path, fps=(FRAMES - 1) / t_end, fields=[], color="displacement", max_frames=FRAMES + 2)
    sim.run(t_end, outputs=[out], progress=False)
    return out.kept


def cast(page: Page, frame: int, camera: Camera) -> np.ndarray:
    """Picture of the bodies by the ray caster."""
    low, high = page._range("displacement")
    bodies = [surface for surface in page.surfaces if surface.kind == "body"]
    points = np.concatenate([s.points[min(frame, len(s.points) - 1)][0] for s in bodies])
    first = np.cumsum([0] + [s.rest.shape[1] for s in bodies])
    triangles = np.concatenate([s.triangles + k for s, k in zip(bodies, first)])
    values = np.concatenate([s.values["displacement"][frame][0] for s in bodies])
    rest = np.concatenate([s.rest[0] for s in bodies])
    renderer = Renderer(triangles, reference=rest, up_axis=page.up_axis)
    return renderer.render(points, map_colors(values, low, high), camera, SIZE).astype(float)


def silhouette(page: Page, frame: int, camera: Camera) -> np.ndarray:
    """Pixels whose middle the bodies cover, by rays."""
    import warp as wp

    bodies = [surface for surface in page.surfaces if surface.kind == "body"]
    points = np.concatenate([to_z_up(s.points[min(frame, len(s.points) - 1)][0], page.up_axis) for s in bodies])
    first = np.cumsum([0] + [s.rest.shape[1] for s in bodies])
    triangles = np.concatenate([s.triangles + k for s, k in zip(bodies, first)])
    forward, right, up = camera.axes()
    tangent = np.tan(np.radians(0.5 * camera.fov))
    x = (np.arange(SIZE[0]) + 0.5) / (0.5 * SIZE[0]) - 1.0 - camera.center[0]
    y = 1.0 - (np.arange(SIZE[1]) + 0.5) / (0.5 * SIZE[1]) - camera.center[1]
    rays = forward + x[None, :, None] * right * tangent * SIZE[0] / SIZE[1] + y[:, None, None] * up * tangent
    with wp.ScopedDevice("cpu"):
        corners = wp.array((points - camera.eye) / camera.size, dtype=wp.vec3)
        mesh = wp.Mesh(corners, wp.array(triangles.ravel(), dtype=wp.int32))
        hit = wp.zeros(SIZE[0] * SIZE[1], dtype=float)
        wp.launch(_meets, len(hit), [mesh.id, wp.array(rays.reshape(-1, 3), dtype=wp.vec3), hit])
        return hit.numpy().reshape(SIZE[1], SIZE[0]) > 0.0


def _kernel() -> Any:
    import warp as wp

    @wp.kernel(enable_backward=False, module="unique")
    def meets(mesh: wp.uint64, rays: wp.array(dtype=wp.vec3), hit: wp.array(dtype=float)):  # type: ignore[valid-type]
        k = wp.tid()
        if wp.mesh_query_ray_anyhit(mesh, wp.vec3(0.0, 0.0, 0.0), wp.normalize(rays[k]), 1.0e4):
            hit[k] = 1.0

    return meets


_meets = _kernel()

# smooth edges off: a pixel is then covered where its middle is, as by a ray
SHARP = """HTMLCanvasElement.prototype.getContext = ((get) => function (kind, how) {
  return get.call(this, kind, kind === "webgl2" ? { ...how, antialias: false } : how);
})(HTMLCanvasElement.prototype.getContext)"""
SETTLE = """([camera, k]) => {
  const view = page.view;
  for (const s of view.surfaces) if (s.kind !== "body") s.world = -9;
  document.getElementById("marks").checked = false;
  document.getElementById("stage").style.cssText = "width: 480px; height: 300px; border: none; min-height: 0";
  view.resize();
  Object.assign(view.camera, camera);
  view.time = k;
  view.draw();
  const { width, height } = document.getElementById("picture"), gl = view.painter.gl;
  const pixels = new Uint8Array(4 * width * height);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  return [width, height, btoa(Array.from(pixels, (x) => String.fromCharCode(x)).join(""))];
}"""


def compare(tab: Tab, page: Page) -> dict[str, Any]:
    """Overlap and difference of colours over all frames."""
    import base64

    bodies = [surface for surface in page.surfaces if surface.kind == "body"]
    swept = np.concatenate([to_z_up(points[0], page.up_axis) for s in bodies for points in s.points])
    camera = Camera.framing(swept, aspect=SIZE[0] / SIZE[1])
    eye = camera.eye - camera.target
    distance = float(np.linalg.norm(eye))
    assert page.up_axis == "Z"
    told = {
        "target": list(camera.target),
        "azimuth": float(np.degrees(np.arctan2(eye[1], eye[0]))), "distance": distance, "size": camera.size,
        "elevation": float(np.degrees(np.arcsin(eye[2] / distance))), "fov": camera.fov, "center": list(camera.center),
    }  # fmt: skip
    overlaps, differences = [], []
    for k in range(len(page.times)):
        width, height, text = tab(SETTLE, [to_json(told), k])
        shot = np.frombuffer(base64.b64decode(text), dtype=np.uint8).reshape(height, width, 4)[::-1].astype(float)
        assert (width, height) == SIZE, (width, height)
        seen, wanted = shot[:, :, 3] >= 127.5, silhouette(page, k, camera)
        overlaps.append(float((seen & wanted).sum() / (seen | wanted).sum()))
        inside = (shot[:, :, 3] == 255.0) & wanted
        differences.append(float(np.abs(shot[:, :, :3] - cast(page, k, camera))[inside].mean() / 255.0))
    return {"frames": len(page.times), "overlap": min(overlaps), "difference": max(differences),
            "mean_difference": float(np.mean(differences))}  # fmt: skip


def long_bar(path: pathlib.Path) -> dict[str, Any]:
    """Size of the page of a bar of 10 000 points on its surface, and the time until it is drawn."""
    mesh = wf.mesh.box((4.0, 1.0, 1.0), cells=(100, 24, 24), element="T4")
    b = wf.ModelBuilder()
    body = b.add_solid(mesh, material=wf.SVK(E=1e7, nu=0.3, density=1000.0), name="bar")
    skin, frames = body.skin, 60
    X = skin.slot_weights @ body.reference + body.origin
    surface = PageSurface("bar", "body", X[None], skin.triangles, skin.edges, np.arange(len(X)))
    surface.values["von_mises"] = []
    for k in range(frames):
        bend, twist = 0.3 * np.sin(0.2 * k), 0.4 * np.sin(0.13 * k) * X[:, 0]
        x = X.copy()
        x[:, 2] += bend * X[:, 0] ** 2 / 4.0 + 0.02 * np.sin(8.0 * X[:, 0] - 0.5 * k)
        y, z = x[:, 1] - 0.5, X[:, 2] - 0.5
        x[:, 1] += y * (np.cos(twist) - 1.0) - z * np.sin(twist)
        x[:, 2] += y * np.sin(twist) + z * (np.cos(twist) - 1.0)
        surface.points.append(x[None].astype(np.float32))
        stress = np.abs(bend * z + 0.1 * np.sin(8.0 * X[:, 0] - 0.5 * k)) * 1e7 + 1e5 * np.abs(
            np.sin(40.0 * X).sum(axis=1)
        )
        surface.values["von_mises"].append(stress[None].astype(np.float32))
    page = Page("bar", "", "Z", False, np.zeros(3), np.zeros((1, 3)), [0], {"von_mises": ("von Mises stress", "Pa")},
                "von_mises", None, (-65.0, 20.0), [surface], [k / 60.0 for k in range(frames)])  # fmt: skip
    path.write_text(page.html(), encoding="utf-8")
    with open_browser() as browser:
        ready = [Tab(browser, path)("page.view.ready / 1000") for _ in range(3)]
    return {"points": len(X), "frames": frames, "MB": path.stat().st_size / 1e6, "ready_s": sorted(ready)[1]}


def main(words: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", required=True)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES))
    given = parser.parse_args(words)
    content: dict[str, Any] = provenance_of([], "cpu") | {"command": "python tests/page_bars.py " + " ".join(words)}
    with quiet_warp(), tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "page.html"
        content["size"] = long_bar(path)
        print(content["size"], flush=True)
        content["pictures"] = []
        for name in given.scenes:
            page = written(name, SCENES[name], path)
            with open_browser() as browser:
                tab = Tab(browser, path, (700, 500), SHARP)
                row = {"scene": name, **compare(tab, page), "errors": len(tab.errors), "requests": len(tab.foreign)}
            content["pictures"].append(row | {"MB": path.stat().st_size / 1e6})
            print(content["pictures"][-1], flush=True)
    write_json(given.out, to_json(content))


if __name__ == "__main__":
    main(sys.argv[1:])
