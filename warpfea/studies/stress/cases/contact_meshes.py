"""Contact with rigid triangle meshes: fast thin sheets, vertices and edges on vertices and edges, exact touch."""

from collections.abc import Callable

import numpy as np

import warpfea as wf

from ..case import FLOAT32_REFUSAL, Answer, Setting, case
from . import contact
from .contact import SIDE, bound_for, center_of_mass, edge_down, make_scene, vertex_down

SQUARE_TRIANGLES = np.array([(0, 1, 2), (0, 2, 3)])


def square_sheet(cells: int = 4, half: float = 0.3, height: float = 0.0) -> wf.TriMesh:
    """A square centred at the cube, of cells x cells squares."""
    g = np.linspace(-half, half, cells + 1) + SIDE / 2
    points = np.array([(x, y, height) for y in g for x in g])
    first = np.arange(cells * (cells + 1)).reshape(cells, cells + 1)[:, :-1].reshape(-1, 1, 1)
    corners = np.array([0, 1, cells + 2, cells + 1])
    return wf.TriMesh(points, (first + corners[SQUARE_TRIANGLES]).reshape(-1, 3))


def pyramid(height: float = 0.2, half: float = 0.2) -> wf.TriMesh:
    """A solid with its tip, of four triangles, at the origin."""
    base = [(-half, -half, -height), (half, -half, -height), (half, half, -height), (-half, half, -height)]
    sides = [(0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)]
    return wf.TriMesh(np.array([*base, (0, 0, 0)]), np.array([*SQUARE_TRIANGLES[:, ::-1].tolist(), *sides]))


def roof(height: float = 0.1, half: float = 0.2, long: float = 0.4) -> wf.TriMesh:
    """A solid with a ridge along y at x = z = 0, in four parts."""
    points, triangles = [], []
    for y in np.linspace(-long, long, 5):
        points += [(-half, y, -height), (half, y, -height), (0, y, 0)]
    for k in range(0, 12, 3):
        for a, b in ((0, 1), (1, 2), (2, 0)):
            triangles += [(k + a, k + a + 3, k + b + 3), (k + a, k + b + 3, k + b)]
    return wf.TriMesh(np.array(points), np.array([*triangles, (0, 1, 2), (12, 14, 13)]))


@case(
    "contact-sheet", contact.GROUP, values=tuple((way, E) for way in ("front", "behind") for E in (1e6, 1e8)),
    quick="none", refusal=contact.REFUSAL_TEXTS,
)  # fmt: skip
def impact(setting: Setting, value: tuple[str, float]) -> Answer:
    """A cube at 100 m/s onto a sheet without thickness, ten of its sides a step: no penetration."""
    way, E = value
    shape = square_sheet()
    if way == "behind":
        shape = wf.TriMesh(shape.points, shape.triangles[:, ::-1])
    return contact.strike(setting, shape, E)


FEATURES: dict[str, tuple[Callable[[], wf.TriMesh], Callable[[], np.ndarray]]] = {
    "vertex on vertex": (pyramid, vertex_down),
    "vertex on edge": (roof, vertex_down),
    "edge on edge": (roof, edge_down),
    "edge on vertex": (pyramid, edge_down),
    "vertex on border": (lambda: square_sheet(2), vertex_down),
}


@case("contact-mesh", contact.GROUP, values=tuple(FEATURES), quick="float64", refusal=FLOAT32_REFUSAL)
def feature_contact(setting: Setting, which: str) -> Answer:
    """A turned cube falls at 1 m/s with its vertex or edge on one of a mesh, 40 steps: no penetration, the
    change of its momentum is the impulse, and no energy is gained."""
    shape, rotation = FEATURES[which]
    s = make_scene(
        shape(),
        E=1e6,
        rotation=rotation(),
        translation=(0, 0, 5e-4),
        mu=0.3,
        restitution=0.5,
        stiffness=("region", 10.0),
    )
    run = s.release(setting, 40, velocity=(0, 0, -1.0), mu=0.3)
    sunk = float(run.sim.contact_record(s.contacts[0]).penetration[0].max()) / SIDE
    return run.impulse_answer(setting, limits={"through": (run.center_depth, 0.0), "sunk": (sunk, 0.3)})


@case("contact-mesh-touch", contact.GROUP, values=("sheet", "borders", "same faces", "tip"), quick="both")
def exact_touch(setting: Setting, which: str) -> Answer:
    """A cube begins in exact touch with a mesh, under its weight, 50 steps: on a sheet, with its edges on borders of
    triangles, face on face with a mesh of its own size, or with a tip on the middle of its face."""
    cube = wf.Box(center=(SIDE / 2, SIDE / 2, -SIDE / 2), size=(SIDE, SIDE, SIDE))
    shapes = {
        "sheet": square_sheet(3),
        "borders": square_sheet(6),
        "same faces": wf.TriMesh(*cube.mesh()),
        "tip": wf.TriMesh(pyramid().points + (SIDE / 2, SIDE / 2, 0), pyramid().triangles),
    }
    s = make_scene(shapes[which], mu=0.5, restitution=0.5, stiffness=("region", 100.0 if which == "tip" else 1.0))
    run = s.release(setting, 50, mu=0.5)
    sunk = float(run.sim.contact_record(s.contacts[0]).penetration[0].max()) / SIDE
    shifted = float(np.abs(center_of_mass(run.sim, s.body)[:2] / SIDE - 0.5).max())
    limits = {"sunk": (sunk, 0.05)}
    if which != "tip":  # it slides off, as four slopes of 45 degrees and mu = 0.5 allow
        limits["shifted"] = (shifted, bound_for(setting, 1e-3, 1e-2))
    return run.impulse_answer(setting, limits=limits)
