"""Bodies that cross each other, or an obstacle, without a contact or deeper than their contact sees: found at some
steps, on the host.

Skins are sets of triangles. Where boxes meet, the edges of each skin are tested against the triangles of the other one
(kernels/contact/crossings.py), in the device's place by the CPU; a half-space against points.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations, product
from typing import Any

import numpy as np
import warp as wp

from ..base.errors import ModelWarning
from ..kernels.contact.crossings import crossing_kernel
from ..model.bodies import Body
from ..model.contacts import Collider
from ..model.shapes import HALF_SPACE
from ..model.surfaces import reference_points

__all__ = ["Crossing", "OverlapCheck"]

MIN_DEPTH_RATIO = 0.05
"""Depth that counts, over 2 V/A of the thinner side (thickness of a plate, a third of a cube's edge): facets of round
bodies that fit into each other overlap by less."""
CHECKS_PER_RUN = 64
"""Number of checks in a run."""
UNSEEN_RATIO = 2.0
"""Depth that counts with a contact, over the penetration that this contact reports."""
MAX_WORLDS = 8
"""Largest number of worlds in which a pair is tested at a time."""
SEGMENTS = 48
"""Segments of a circle of a round obstacle."""
MAX_NAMED = 3
"""Largest number of pairs named in a warning."""


@dataclass(frozen=True)
class Crossing:
    """Two sides that cross without a contact, or deeper than it sees.

    Attributes:
        first, second: names of a body, and of a body or a collider.
        time: s, in statics load factor, of the check that found it. world: the first one in which. depth: m.
        text: sentence.
    """

    first: str
    second: str
    time: float
    world: int
    depth: float
    text: str


class _Side:
    """Triangles of a body or a collider.

    Attributes:
        name: as in messages. points: function of displacements (worlds, slots, 3), m, and poses of colliders, or None
            -> (worlds, points, 3), m.
        triangles: (T, 3); edges: (E, 2), each once. closed: True with an inside. thickness: 2 V/A, m.
    """

    def __init__(
        self, thing: Body | Collider, points: Callable[[np.ndarray, Any], np.ndarray], X: np.ndarray,
        triangles: np.ndarray,
    ) -> None:  # fmt: skip
        kind = "body" if isinstance(thing, Body) else "collider"
        self.thing, self.name = thing, f"{kind} {thing.name!r}"
        self.points, self.triangles = points, np.asarray(triangles, dtype=np.int32)
        ends = np.sort(self.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        self.edges = np.unique(ends, axis=0)
        self.closed = isinstance(thing, Body) or not thing.is_sheet
        self.plane = isinstance(thing, Collider) and thing.shape.kind == HALF_SPACE
        a, b, c = np.moveaxis(X[self.triangles] - X.mean(axis=0), 1, 0)
        normal = np.cross(b - a, c - a)
        area, volume = np.linalg.norm(normal, axis=1).sum() / 2.0, np.einsum("ij,ij->", a, normal) / 6.0
        self.thickness = 2.0 * float(volume / area) if self.closed and not self.plane else np.inf


def _body_side(body: Body) -> _Side:
    """Skin of a body."""
    skin = body.face_skin  # whatever is drawn
    weights, slots = skin.slot_weights, body.slot_range
    X = reference_points(body, weights)

    def points(u: np.ndarray, poses: Any) -> np.ndarray:
        return X + np.stack([weights @ row for row in u[:, slots]])

    return _Side(body, points, X, skin.triangles)


def _collider_side(collider: Collider, k: int) -> _Side:
    """Surface of a collider, the k-th of its model; of a half-space a square, whose normal counts."""
    shape = collider.shape
    center, axes = shape.frame()
    X, triangles = shape.mesh(SEGMENTS)
    local = (X - center) @ axes

    def points(u: np.ndarray, poses: Any) -> np.ndarray:
        if poses is None:
            return np.repeat(X[None], len(u), axis=0)
        position, rotation = poses[0][:, k], poses[1][:, k]
        if shape.kind == HALF_SPACE:
            position = position + poses[2][:, k, None] * rotation[:, :, 2]
        return np.asarray(position[:, None] + np.einsum("bij,nj->bni", rotation, local))

    return _Side(collider, points, X, triangles)


class OverlapCheck:
    """Check of a simulation for crossings of bodies that no contact sees.

    Pairs of bodies, and of bodies and colliders; not those that a weld, a joint or a constraint connects, those that
    cross when the first step begins, a body with itself, and moving colliders of a model without contact with
    colliders. Each pair is said once.

    Attributes:
        found: crossings so far. pairs: (P, 2) indices of what is still tested.
    """

    def __init__(self, sim: Any) -> None:
        d = sim.model.description
        contacts, attached = d.contact_pairs, d.attached_pairs
        posed = sim.results.collider_poses() is not None
        obstacles = [collider for collider in d.colliders if posed or not collider.moves]
        pairs = [pair for pair in [*combinations(d.bodies, 2), *product(d.bodies, obstacles)]
                 if frozenset(map(id, pair)) not in attached]  # fmt: skip
        things = {id(thing): thing for pair in pairs for thing in pair}
        number = {key: k for k, key in enumerate(things)}
        self.found: list[Crossing] = []
        self._things, self._sides = list(things.values()), list[_Side]()
        self.pairs = np.array([[number[id(thing)] for thing in pair] for pair in pairs], dtype=int).reshape(-1, 2)
        self._contacts = [contacts.get(frozenset(map(id, pair)), []) for pair in pairs]
        self._begun, self._calls, self._every = False, 0, 1

    def set_run(self, steps: int = 0) -> None:
        """Check about `CHECKS_PER_RUN` of the steps of a run; without: each call of `step`."""
        self._calls, self._every = 0, max(1, -(-steps // CHECKS_PER_RUN))

    def begin(self, sim: Any) -> None:
        """Leave out pairs that cross before the first step."""
        if not self._begun:
            self._begun = True
            self._crossings(sim)

    def after_step(self, sim: Any) -> None:
        """Check, if it is time, and warn of pairs that cross now."""
        self._calls += 1
        if self._calls % self._every == 0:
            self.check(sim)

    def check(self, sim: Any) -> None:
        """Check now, and warn of pairs that cross."""
        new = self._crossings(sim)
        self.found += new
        if new:
            more = f"; and {len(new) - MAX_NAMED} more pairs" if len(new) > MAX_NAMED else ""
            texts = "; ".join(crossing.text for crossing in new[:MAX_NAMED])
            warnings.warn(f"{texts}{more}", ModelWarning, stacklevel=4)

    def _seen_depth(self, sim: Any, pair: int, world: int) -> float:
        """Largest penetration, m, that the contacts of a pair report of the last step."""
        depths = [sim.contact_record(contact).penetration[world, -1:] for contact in self._contacts[pair]]
        return float(np.max(np.concatenate([[0.0], *depths])))

    def _crossings(self, sim: Any) -> list[Crossing]:
        """New crossings; their pairs are left out from now on."""
        if not len(self.pairs):
            return []
        if not self._sides:
            index = {id(collider): k for k, collider in enumerate(sim.model.description.colliders)}
            for x in self._things:
                self._sides.append(_body_side(x) if isinstance(x, Body) else _collider_side(x, index[id(x)]))
        u, poses = sim.state.displacement.numpy().astype(float), sim.results.collider_poses()
        points = [side.points(u, poses) for side in self._sides]
        reach = np.array([np.inf if side.plane else 0.0 for side in self._sides])[:, None, None]
        low, high = np.stack([x.min(axis=1) for x in points]) - reach, np.stack([x.max(axis=1) for x in points]) + reach
        i, j = self.pairs.T
        least = MIN_DEPTH_RATIO * np.array([side.thickness for side in self._sides])[self.pairs].min(axis=1)
        inner = np.where(np.array([side.closed for side in self._sides])[j], least, 0.0)[:, None, None]
        meet = ((low[i] + inner <= high[j]) & (low[j] + inner <= high[i])).all(axis=2)
        found, out = np.zeros(len(meet), dtype=bool), []
        for k in np.flatnonzero(meet.any(axis=1)).tolist():
            sides = self._sides[i[k]], self._sides[j[k]]
            for world in np.flatnonzero(meet[k])[:MAX_WORLDS].tolist():
                depth = _crossing_depth(*sides, points[i[k]][world], points[j[k]][world], least[k])
                seen = self._seen_depth(sim, k, world) if depth > least[k] else 0.0
                if depth > least[k] + UNSEEN_RATIO * seen:
                    text = _crossing_text(sim, *sides, world, depth, self._contacts[k], seen)
                    time = float((sim.time if sim.load is None else sim.load)[world])
                    out.append(Crossing(sides[0].thing.name, sides[1].thing.name, time, world, depth, text))
                    found[k] = True
                    break
        self.pairs = self.pairs[~found]
        self._contacts = [contacts for contacts, gone in zip(self._contacts, found) if not gone]
        return out


def _crossing_text(
    sim: Any, one: _Side, other: _Side, world: int, depth: float, contacts: list[Any], seen: float
) -> str:  # fmt: skip
    """Sentence on two sides that cross."""
    static = sim.load is not None
    since = f"{100.0 * sim.load[world]:.4g} % of the load" if static else f"t = {sim.time[world]:.4g} s"
    where = f" in world {world}" if sim.model.worlds > 1 else ""
    without, cure = "have no contact and ", (
        f"write b.add_contact({one.thing.name}, {other.thing.name}) with their handles, or nothing if that is meant"
    )  # fmt: skip
    if contacts:
        names = " and ".join(repr(contact.name) for contact in contacts)
        without, cure = "", f"contact {names} sees {seen:.2g} m: take smaller elements there, or contact of all faces"
    return f"{one.name} and {other.name} {without}cross since {since}{where} ({depth:.2g} m deep): {cure}"


def _crossing_depth(one: _Side, other: _Side, x: np.ndarray, y: np.ndarray, least: float) -> float:
    """Largest depth, m, at which an edge of one side lies in the other, with positions x and y (points, 3), m; depths
    below `least` may be 0."""
    if other.plane:
        normal = np.cross(y[1] - y[0], y[2] - y[0])
        return float(((y[0] - x) @ normal).max() / np.linalg.norm(normal))
    return max(_depth_in(other, y, one, x, least), _depth_in(one, x, other, y, least))


def _depth_in(mesh: _Side, points: np.ndarray, other: _Side, x: np.ndarray, least: float) -> float:
    """Largest depth, m, of the edges of another side in a mesh."""
    start, end = x[other.edges[:, 0]], x[other.edges[:, 1]]
    low, high = points.min(axis=0), points.max(axis=0)
    inner = least if mesh.closed else 0.0
    near = ((np.minimum(start, end) <= high - inner) & (np.maximum(start, end) >= low + inner)).all(axis=1)
    if not near.any() or not np.isfinite(points).all():
        return 0.0
    center, size = 0.5 * (low + high), float((high - low).max())
    with wp.ScopedDevice("cpu"):
        scaled: list[Any] = [
            wp.array((values - center) / size, dtype=wp.vec3) for values in (points, start[near], end[near])
        ]
        triangles: Any = wp.array(mesh.triangles.ravel(), dtype=wp.int32)
        device = wp.Mesh(scaled[0], triangles, support_winding_number=mesh.closed)
        out = wp.zeros(int(near.sum()), dtype=float)
        wp.launch(crossing_kernel(), len(out), [device.id, int(mesh.closed), *scaled[1:], out], device="cpu")
        return float(out.numpy().max()) * size
