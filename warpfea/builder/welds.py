"""Welds of faces to other bodies: mortar ties, zero mean gap weighted with each function of the first face."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..base.errors import ModelError
from ..model import assembly
from ..model.bodies import Body
from ..model.description import support_slots
from ..model.discretisation import Discretisation
from ..model.handles import NodeSet, SurfaceSet
from ..model.joints import Joint, Vector, VectorPart
from ..model.locate import locate
from ..model.surfaces import named_faces
from .joints import pin_rows

__all__ = ["make_weld"]

PARTS_PER_ELEMENT = 2.0
MAX_PARTS = 8
SURFACE_TOL = 0.5
"""Distance from a surface's points, over its size, beyond which a face is off it."""
GAP_TOL = 1e-4
"""Bridged gap over the element size: files hold rounded coordinates."""


def make_weld(first: NodeSet | SurfaceSet, second: SurfaceSet | Body, name: str) -> Joint:
    """Compose a weld; see ModelBuilder.weld."""
    what = f"weld {name!r}"
    holder = second if isinstance(second, Body) else second.body
    body = first.body
    if body is holder:
        raise ModelError(f"{what}: both sides are body {body.name!r}")
    face = first if isinstance(first, SurfaceSet) else _face(first)
    within = second if isinstance(second, SurfaceSet) else None
    if face is not None:
        gaps, anchor = _mortar(face, holder, within, what)
        label = f"surface {face.name!r} of body {body.name!r}" if face.name else f"a surface of body {body.name!r}"
    else:
        assert isinstance(first, NodeSet)
        gaps, anchor = _pins(first, holder, within, what)
        label = f"{len(gaps)} nodes of body {body.name!r}"
    rows = [row for gap in gaps for row in pin_rows(gap)]
    return Joint(name, "weld", rows, anchor, f"body {holder.name!r} and {label}")


def _face(nodes: NodeSet) -> SurfaceSet | None:
    """Face of a beam or shell denoted by a named set of nodes."""
    body = nodes.body
    if body.family.solid or not nodes.name:
        return None
    faces = named_faces(body).get(nodes.name)
    return None if faces is None else SurfaceSet(body, faces, nodes.name)


def _mortar(
    face: SurfaceSet, holder: Discretisation, within: SurfaceSet | None, what: str
) -> tuple[list[Vector], Vector]:
    """One vector per slot i of the face: int phi_i (x - x_holder) dA / int |phi_i| dA."""
    body = face.body
    t = assembly.facet_tables(face, _parts(face, holder))
    X, dA = assembly.facet_positions_and_areas(body, t)
    _check_near(X.reshape(-1, 3), within, what)
    n, m = body.slot_count, holder.slot_count
    F, Q, _ = t.shape.shape
    own, other = np.zeros((F * Q, n)), np.zeros((F * Q, m))
    for k, (f, q) in enumerate(np.ndindex(F, Q)):
        np.add.at(own[k], t.conn[f], t.shape[f, q])
        place = _locate(holder, X[f, q], what)
        np.add.at(other[k], place.slots, place.weights)
    share = dA.ravel()
    gaps = []
    for slot in np.unique(t.conn):
        test = own[:, slot] * share
        size = np.abs(test).sum()
        if size > 1e-12 * share.sum():
            gaps.append(_gap(body, holder, test @ own / size, test @ other / size))
    mean = share / share.sum()
    return gaps, _anchor(body, mean @ own, mean @ X.reshape(-1, 3))


def _parts(face: SurfaceSet, holder: Discretisation) -> int:
    """Quadrature subdivisions of a face that resolve the other body's element boundaries."""
    _, dA = assembly.facet_positions_and_areas(face.body, assembly.facet_tables(face))
    area = float(dA.sum(axis=1).max())
    size = np.cbrt(float(np.median(assembly.element_volumes(holder))))
    return int(np.clip(np.ceil(PARTS_PER_ELEMENT * np.sqrt(area) / size), 1, MAX_PARTS))


def _pins(nodes: NodeSet, holder: Discretisation, within: SurfaceSet | None, what: str) -> tuple[list[Vector], Vector]:
    """Pins of nodes at their positions in the second body."""
    body = nodes.body
    slots = support_slots(nodes, "position")
    places = body.reference[slots] + body.origin
    _check_near(places, within, what)
    gaps = []
    for slot, X in zip(slots, places):
        own, other = np.zeros(body.slot_count), np.zeros(holder.slot_count)
        own[slot] = 1.0
        place = _locate(holder, X, what)
        np.add.at(other, place.slots, place.weights)
        gaps.append(_gap(body, holder, own, other))
    mean = np.zeros(body.slot_count)
    mean[slots] = 1.0 / len(slots)
    return gaps, _anchor(body, mean, places.mean(axis=0))


def _check_near(X: np.ndarray, within: SurfaceSet | None, what: str) -> None:
    """Raise ModelError for points (n, 3) outside the bounding box of the named surface."""
    if within is None:
        return
    body = within.body
    x = assembly.facet_positions_and_areas(body, assembly.facet_tables(within))[0].reshape(-1, 3)
    low, high = x.min(axis=0), x.max(axis=0)
    slack = SURFACE_TOL * float(np.linalg.norm(high - low))
    off = np.flatnonzero(((low - slack > X) | (high + slack < X)).any(axis=1))
    if len(off):
        raise ModelError(
            f"{what}: the point {np.round(X[off[0]], 6).tolist()} of the first face is not on surface {within.name!r} "
            f"of body {body.name!r}"
        )


def _locate(holder: Discretisation, X: np.ndarray, what: str) -> Any:
    try:
        return locate(holder, X, slack=GAP_TOL)
    except ModelError as error:
        raise ModelError(f"{what}: {error}; the welded face must lie in the other body") from None


def _gap(body: Discretisation, holder: Discretisation, own: np.ndarray, other: np.ndarray) -> Vector:
    a, b = np.flatnonzero(own), np.flatnonzero(other)
    return Vector(np.zeros(3), (VectorPart(body, a, own[a], True), VectorPart(holder, b, -other[b], False)))


def _anchor(body: Discretisation, weights: np.ndarray, X: np.ndarray) -> Vector:
    slots = np.flatnonzero(weights)
    return Vector(X, (VectorPart(body, slots, weights[slots], True),))
