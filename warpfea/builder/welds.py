"""Welds of faces to other bodies: mortar ties, zero mean gap weighted with each function of the first face."""

from typing import Any

import numpy as np

from ..base.errors import ModelError
from ..model import assembly
from ..model.bodies import Body, locate
from ..model.description import support_slots
from ..model.discretisation import Discretisation
from ..model.handles import NodeSet, SurfaceSet
from ..model.joints import Joint, Vector, VectorPart
from ..model.rigid import RigidBody
from ..model.surfaces import named_faces
from .joints import make_joint, pin_rows

__all__ = ["make_weld"]

SUBDIVISIONS_PER_ELEMENT = 2.0
MAX_SUBDIVISIONS = 8
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
    if isinstance(body, RigidBody) and isinstance(holder, RigidBody):
        at = body.mean_point(first)
        return make_joint("fixed", holder.point(at.X), at, None, None, None, None, name)
    face = first if isinstance(first, SurfaceSet) else _named_face(first)
    target_surface = second if isinstance(second, SurfaceSet) else None
    if face is not None:
        gaps, anchor = _mortar_gaps(face, holder, target_surface, what)
        label = f"surface {face.name!r} of body {body.name!r}" if face.name else f"a surface of body {body.name!r}"
    else:
        assert isinstance(first, NodeSet)
        gaps, anchor = _node_gaps(first, holder, target_surface, what)
        label = f"{len(gaps)} nodes of body {body.name!r}"
    rows = [row for gap in gaps for row in pin_rows(gap)]
    return Joint(name, "weld", rows, anchor, f"body {holder.name!r} and {label}")


def _named_face(nodes: NodeSet) -> SurfaceSet | None:
    """Face of a beam or shell denoted by a named set of nodes."""
    body = nodes.body
    if body.family.solid or not nodes.name:
        return None
    faces = named_faces(body).get(nodes.name)
    return None if faces is None else SurfaceSet(body, faces, nodes.name)


def _mortar_gaps(
    face: SurfaceSet, holder: Discretisation, target_surface: SurfaceSet | None, what: str
) -> tuple[list[Vector], Vector]:
    """One vector per slot i of the face: int phi_i (x - x_holder) dA / int |phi_i| dA."""
    body = face.body
    t = assembly.facet_tables(face, _subdivisions(face, holder))
    X, dA = assembly.facet_positions(body, t), assembly.facet_areas(body, t)
    _check_near_surface(X.reshape(-1, 3), target_surface, what)
    if isinstance(holder, RigidBody):
        return _rigid_gaps(body, np.unique(t.conn), holder), _mean_of_face(body, t, X, dA)
    n, m = body.slot_count, holder.slot_count
    F, Q, _ = t.shape.shape
    own_weights, holder_weights = np.zeros((F * Q, n)), np.zeros((F * Q, m))
    for k, (f, q) in enumerate(np.ndindex(F, Q)):
        np.add.at(own_weights[k], t.conn[f], t.shape[f, q])
        location = _locate(holder, X[f, q], what)
        np.add.at(holder_weights[k], location.slots, location.weights)
    share = dA.ravel()
    gaps = []
    for slot in np.unique(t.conn):
        test = own_weights[:, slot] * share
        size = np.abs(test).sum()
        if size > 1e-12 * share.sum():
            gaps.append(_gap_vector(body, holder, test @ own_weights / size, test @ holder_weights / size))
    return gaps, _mean_of_face(body, t, X, dA)


def _rigid_gaps(body: Discretisation, slots: np.ndarray, holder: RigidBody) -> list[Vector]:
    """Each slot of a face tied to its value in the affine motion of a rigid part: what the mortar tie comes to."""
    E, position = body.reference[slots], body.slot_kind[slots] == 0
    weights = np.column_stack([position, E + position[:, None] * (body.origin - holder.com)]) @ holder.affine
    return [_gap_vector(body, holder, own, w) for own, w in zip(np.eye(body.slot_count)[slots], weights)]


def _mean_of_face(body: Discretisation, t: assembly.FacetTables, X: np.ndarray, dA: np.ndarray) -> Vector:
    """Area mean of a face."""
    weights = np.zeros(body.slot_count)
    np.add.at(weights, t.conn, np.einsum("fq,fqi->fi", dA / dA.sum(), t.shape))
    return _mean_point(body, weights, np.einsum("fq,fqk->k", dA / dA.sum(), X))


def _subdivisions(face: SurfaceSet, holder: Discretisation) -> int:
    """Quadrature subdivisions of a face that resolve the other body's element boundaries."""
    dA = assembly.facet_areas(face.body, assembly.facet_tables(face))
    area = float(dA.sum(axis=1).max())
    size = np.cbrt(float(np.median(assembly.element_volumes(holder))))
    return int(np.clip(np.ceil(SUBDIVISIONS_PER_ELEMENT * np.sqrt(area) / size), 1, MAX_SUBDIVISIONS))


def _node_gaps(
    nodes: NodeSet, holder: Discretisation, target_surface: SurfaceSet | None, what: str
) -> tuple[list[Vector], Vector]:
    """Pins of nodes at their positions in the second body."""
    body = nodes.body
    slots = support_slots(nodes, "position")
    places = body.reference[slots] + body.origin
    _check_near_surface(places, target_surface, what)
    gaps = []
    for slot, X in zip(slots, places):
        own_weights, holder_weights = np.zeros(body.slot_count), np.zeros(holder.slot_count)
        own_weights[slot] = 1.0
        location = _locate(holder, X, what)
        np.add.at(holder_weights, location.slots, location.weights)
        gaps.append(_gap_vector(body, holder, own_weights, holder_weights))
    mean = np.zeros(body.slot_count)
    mean[slots] = 1.0 / len(slots)
    return gaps, _mean_point(body, mean, places.mean(axis=0))


def _check_near_surface(X: np.ndarray, target_surface: SurfaceSet | None, what: str) -> None:
    """Raise ModelError for points (n, 3) outside the bounding box of the named surface."""
    if target_surface is None:
        return
    body = target_surface.body
    x = assembly.facet_positions(body, assembly.facet_tables(target_surface)).reshape(-1, 3)
    low, high = x.min(axis=0), x.max(axis=0)
    slack = SURFACE_TOL * float(np.linalg.norm(high - low))
    off = np.flatnonzero(((low - slack > X) | (high + slack < X)).any(axis=1))
    if len(off):
        raise ModelError(
            f"{what}: the point {np.round(X[off[0]], 6).tolist()} of the first face is not on surface "
            f"{target_surface.name!r} of body {body.name!r}"
        )


def _locate(holder: Discretisation, X: np.ndarray, what: str) -> Any:
    if isinstance(holder, RigidBody):
        return holder.point(X)
    try:
        return locate(holder, X, slack=GAP_TOL)
    except ModelError as error:
        raise ModelError(f"{what}: {error}; the welded face must lie in the other body") from None


def _gap_vector(
    body: Discretisation, holder: Discretisation, own_weights: np.ndarray, holder_weights: np.ndarray
) -> Vector:
    a, b = np.flatnonzero(own_weights), np.flatnonzero(holder_weights)
    return Vector(
        np.zeros(3), (VectorPart(body, a, own_weights[a], True), VectorPart(holder, b, -holder_weights[b], False))
    )


def _mean_point(body: Discretisation, weights: np.ndarray, X: np.ndarray) -> Vector:
    slots = np.flatnonzero(weights)
    return Vector(X, (VectorPart(body, slots, weights[slots], True),))
