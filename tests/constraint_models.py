"""Bodies with joints between them, and states of these."""

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation as Turn

import warpfea as wf

LAW = wf.SVK(E=1e7, nu=0.3, density=1000.0)
ANCHOR = np.array([1.0, 0.05, 0.1])
AXIS = np.array([0.3, -0.5, 0.8])
AXIS = AXIS / np.linalg.norm(AXIS)


def box(b, low, high, cells=(1, 1, 1), law=LAW, **options):
    low, high = np.array(low, float), np.array(high, float)
    mesh = wf.mesh.box(tuple(high - low), cells=cells)
    return b.add_solid(mesh, transform=(np.eye(3), low), material=law, **options)


def handles(kind, b, where):
    """A handle of each sort, on a body that ends (parent) or starts (child) near the anchor."""
    x = (0.0, 1.0) if where == "parent" else (1.0, 2.0)
    end = "x+" if where == "parent" else "x-"
    if kind == "ground":
        return wf.GROUND
    if kind.startswith("beam"):
        beam = b.add_beam(
            [(x[0], 0.05, 0.1), (x[1], 0.05, 0.1)], elements=1, section=wf.Rectangle(0.05, 0.04), normal=(0, 0, 1),
            material=LAW,
        )  # fmt: skip
        return beam.end if where == "parent" else beam.start
    if kind == "shell":
        grid = wf.mesh.grid((1, 0.1), cells=(1, 1))
        plate = b.add_shell(grid, thickness=0.02, material=LAW, transform=(np.eye(3), (x[0], 0.0, 0.1)))
        return plate.edge(end)
    if kind == "shell point":
        grid = wf.mesh.grid((1, 0.1), cells=(1, 1))
        plate = b.add_shell(grid, thickness=0.02, material=LAW, transform=(np.eye(3), (x[0], 0.0, 0.1)))
        return plate.at(tuple(ANCHOR))
    body = box(b, (x[0], 0, 0), (x[1], 0.1, 0.2))
    if kind == "surface":
        return body.surface(end)
    if kind == "nodes":
        return body.nodes(lambda X: np.abs(X[:, 0] - 1.0) < 0.6)
    return body.at(tuple(ANCHOR))


def joined(kind, pair, drive=None, axis=AXIS, **options):
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    parent, child = (handles(p, b, where) for p, where in zip(pair, ("parent", "child")))
    extra = {"axis": axis} if kind in ("universal", "revolute", "cylindrical", "translational") else {}
    if kind == "distance":
        if "ground" in pair:
            extra["anchor"] = (1.3, 0.4, 0.5)
        else:
            child = child.body.at(centre(child.body))
    else:
        extra["anchor"] = ANCHOR
    joint = b.add_joint(kind, parent=parent, child=child, drive=drive, **extra)
    return b.finalize(device="cpu", **options), joint


def centre(body):
    low, high = body.mesh.bounding_box()
    return tuple(0.5 * (np.asarray(low) + np.asarray(high)))


def places(model):
    """(slots, 3) slot values in space, of the reference."""
    position = (model.slot_table.kind == 0)[:, None]
    origin = np.concatenate([np.tile(b.origin, (b.slot_count, 1)) for b in model.bodies])
    return model.slot_table.reference + position * origin, position


def moved(model, motions):
    """Displacements that carry each body by its rotation and translation (about the anchor)."""
    x, position = places(model)
    u = np.zeros_like(x)
    for body, (turn, shift) in zip(model.bodies, motions):
        rows = body.slots
        arm = x[rows] - position[rows] * ANCHOR
        u[rows] = turn.apply(arm) + position[rows] * (ANCHOR + shift) - x[rows]
    return u


def state_at(model, u):
    state = model.state()
    state.displacement.assign(np.tile(u, (model.worlds, 1, 1)))
    return state


def random_pose(model, rng, size=0.1):
    """A rigid motion of each body and a deformation on top."""
    u = moved(model, [(Turn.random(random_state=rng), rng.normal(size=3)) for _ in model.bodies])
    return u + size * rng.normal(size=u.shape)


@wp.func
def wave(t: wp.float64) -> wp.float64:
    return wp.float64(0.7) + wp.sin(t)


def bodies():
    b = wf.ModelBuilder()
    return b, box(b, (0, 0, 0), (1, 0.2, 0.2), name="one"), box(b, (1, 0, 0), (2, 0.2, 0.2), name="two")
