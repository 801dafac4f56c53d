"""Marks of supports, joints, loads and probes: where they are drawn, and which way a load acts."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from ..kernels.terms.springs import LENGTH
from ..model.joints import Vector
from ..model.surfaces import reference_points

__all__ = ["KINDS", "MARKED_WORLDS", "Markers", "group_marks"]

Array = npt.NDArray[Any]
KINDS = ("support", "joint", "spring", "load", "probe")
"""Kinds of marks; a spring has two points, one after the other."""
MARKED_WORLDS = 16
"""Pictures and files of more worlds have no marks."""
SHOWN_POINTS = 12
"""Number of points drawn of a support or a pressure."""
SHOWN_JOINTS = 100
"""Number of joints drawn of a model."""


class Markers:
    """The marks of a simulation.

    Supports and pressures are at points of the drawn surface. Joints, loads and probes have points of their own, linear
    in the slots, that are evaluated at each frame.

    Attributes:
        on_surface: (kind, name, index of the body, its points); kind "support" or "pressure".
        own: (kind, name) of each point of its own; kind "joint", "load" or "probe".
    """

    def __init__(self, sim: Any, bodies: list[Any]) -> None:
        description = sim.model.description
        self.on_surface: list[tuple[str, str, int, Array]] = []
        self.own: list[tuple[str, str]] = []
        self._points: list[tuple[Array, Array, Array]] = []  # value at rest, slots, weights
        self._weights: sp.csr_matrix | None = None
        self._laws: list[Any] = []
        drawn = {id(body): k for k, body in enumerate(bodies)}
        for support in getattr(description, "supports", ()):
            if id(support.body) in drawn:
                at = support.body.reference[support.slots] + support.body.origin
                at = at[support.body.slot_kind[support.slots] == 0]
                fixed = support.law is None and support.node_laws is None and support.rotation is None
                name = f"{'clamp' if fixed else 'drive'} of {support.body.name}"
                self._mark_surface("support", name, drawn[id(support.body)], support.body, at)
        for pressure in getattr(description, "pressures", ()):
            body = pressure.surface.body
            if id(body) in drawn and body.family.solid:
                at = body.mesh.points[pressure.surface.nodes].mean(axis=1)
                self._mark_surface("pressure", f"pressure on {body.name}", drawn[id(body)], body, at)
        joints = [joint for joint in getattr(description, "joints", ()) if joint.kind != "rigid"]
        for joint in joints[:SHOWN_JOINTS]:
            slots, weights, _ = joint.anchor.entries()
            self._mark("joint", f"{joint.name} ({joint.kind})", joint.anchor.value, slots, weights)
        for spring in getattr(description, "springs", ())[:SHOWN_JOINTS]:
            if spring.kind == LENGTH:
                for X, slots, weights in _spring_ends(spring.items[0][0]):
                    self._mark("spring", spring.name, X, slots, weights)
        for load in getattr(description, "dead_loads", ()):
            share = np.abs(np.asarray(load.weights, dtype=float)).reshape(len(load.slots), -1).sum(axis=1)
            share[load.body.slot_kind[load.slots] != 0] = 0.0
            if share.sum() > 0.0:
                share /= share.sum()
                at = share @ (load.body.reference[load.slots] + load.body.origin)
                self._mark(
                    "load", f"{load.name} on {load.body.name}", at, load.body.slot_offset + load.slots, share, load.law
                )
        for probe in getattr(description, "probes", ()):
            self._mark("probe", probe.name, probe.X, probe.body.slot_offset + probe.slots, probe.weights)

    def _mark_surface(self, kind: str, name: str, index: int, body: Any, at: Array) -> None:
        """Mark the drawn points next to some of the places (n, 3)."""
        from scipy.spatial import cKDTree

        if len(at):
            some = at[np.unique(np.linspace(0, len(at) - 1, SHOWN_POINTS).astype(int))]
            skin = reference_points(body, body.skin.slot_weights)
            self.on_surface.append((kind, name, index, np.unique(cKDTree(skin).query(some)[1])))

    def _mark(self, kind: str, name: str, value: Array, slots: Array, weights: Array, law: Any = None) -> None:
        self.own.append((kind, name))
        self._points.append((np.asarray(value, dtype=float), slots, np.asarray(weights, dtype=float)))
        self._laws.append(law)

    def points(self, sim: Any, scale: float = 1.0, worlds: Sequence[int] | None = None) -> Array:
        """(B, n, 3) places of the marks of their own, m, with displacements multiplied by `scale`, in all worlds or
        some."""
        if not self.own:
            return np.zeros((int(sim.model.worlds) if worlds is None else len(worlds), 0, 3))
        if self._weights is None:
            self._weights = weight_rows([pair[1:] for pair in self._points], int(sim.model.slots))
        sums = sim.model.terms.evaluation.samples.slot_sums(sim.state.displacement, self._weights, worlds)
        return np.stack([X for X, _, _ in self._points]) + scale * sums

    def kinds(self, worlds: int) -> list[str]:
        """Kinds of the points of `all_points`."""
        on = [("load" if k == "pressure" else k, len(points)) for k, _, _, points in self.on_surface]
        return worlds * [kind for kind, count in on for _ in range(count)] + worlds * [kind for kind, _ in self.own]

    def world_points(self, drawn: list[Array], own: Array) -> Array:
        """(B, n, 3) points of the marks of each world, from drawn points (B, P, 3) of bodies and `own` (B, m, 3)."""
        return np.concatenate([drawn[body][:, points] for _, _, body, points in self.on_surface] + [own], axis=1)

    def all_points(self, drawn: Array, firsts: list[int], counts: list[int], own: Array) -> Array:
        """(n, 3) points of all marks: those on bodies, whose drawn points begin at `firsts` with `counts` for each
        world, then `own` (B, n, 3)."""
        rows = [
            firsts[body] + world * counts[body] + points
            for world in range(len(own))
            for _, _, body, points in self.on_surface
        ]
        on_bodies = drawn[np.concatenate(rows)] if rows else np.zeros((0, 3))
        return np.concatenate([on_bodies, own.reshape(-1, 3)])

    def vectors(self, time: float, factor: float = 1.0) -> list[Array | None]:
        """Force of each mark of its own at a time (s), times a load factor; None unless samples give it."""
        return [None if law is None else _sampled(law, time, factor) for law in self._laws]


def weight_rows(rows: list[tuple[Array, Array]], width: int) -> sp.csr_matrix:
    """Sparse (n, width) of the columns and weights of each row."""
    start = np.cumsum([0, *(len(columns) for columns, _ in rows)])
    columns, weights = (np.concatenate(part) for part in zip(*rows))
    return sp.csr_matrix((weights, columns, start), shape=(len(rows), width))


def group_marks(kinds: list[str]) -> list[tuple[str, list[int]]]:
    """Kinds with their points: two of a spring, one of others."""
    out: list[tuple[str, list[int]]] = []
    for k, kind in enumerate(kinds):
        if kind == "spring" and out and out[-1][0] == "spring" and len(out[-1][1]) == 1:
            out[-1][1].append(k)
        else:
            out.append((kind, [k]))
    return out


def _spring_ends(gap: Vector) -> list[tuple[Array, Array, Array]]:
    """Place at rest, model slots and weights of both ends of a spring along `gap`; an end on the ground has none."""
    ends: list[tuple[Array, Array, Array] | None] = []
    for child, sign in ((False, -1.0), (True, 1.0)):
        parts = [part for part in gap.parts if part.on_child_side == child]
        places = [
            sign
            * part.weights
            @ (part.body.reference[part.slots] + (part.body.slot_kind[part.slots] == 0)[:, None] * part.body.origin)
            for part in parts
        ]
        slots = [part.body.slot_offset + part.slots for part in parts]
        weights = [sign * part.weights for part in parts]
        ends.append((sum(places), np.concatenate(slots), np.concatenate(weights)) if parts else None)
    first, second = ends
    none = np.zeros(0, dtype=np.int64), np.zeros(0)
    first = first or (second[0] - gap.value, *none)  # type: ignore[index]
    return [first, second or (first[0] + gap.value, *none)]


def _sampled(law: Any, time: float, factor: float) -> Array | None:
    """Value (3,) of a law given by samples; None for a function or a control."""
    if not len(law.times) or law.scalar:
        return None
    return np.array([np.interp(time, law.times, column) for column in np.asarray(law.values).T]) * factor
