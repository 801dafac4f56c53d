"""Parent coordinates of reference positions in elements, and fine surfaces that follow the elements of a body."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ..base.errors import ModelError
from .discretisation import Discretisation, element_functions
from .surfaces import Skin, sparse_weights

__all__ = ["embedded_skin", "parent_coordinates", "shape_at_own_points"]

PAIRS_AT_ONCE = 20000
"""Points, each with its element, at once: bounds the memory."""
ROUND_OFF = 1e-9
"""Distance over the size of an element up to which a point counts as inside."""
NEWTON_STEPS, SWEEPS = 4, 60
"""Iterations to the nearest point of an element. A bound: what they leave is extrapolated."""


def embedded_skin(
    body: Discretisation, points: np.ndarray, triangles: np.ndarray, distance: float | None, what: str
) -> Skin:
    """A fine surface drawn in place of the faces of a body.

    With X* the nearest point of the nearest element, F its deformation gradient: x = x(X*) + F (X - X*), exact for
    rigid motions and homogeneous deformations; a vertex within an element has X* = X. Fields are those at X*.

    Args:
        points: (n, 3) in the reference of the body, m. triangles: (m, 3).
        distance: largest |X - X*|, m; None: a quarter of the largest element.
        what: begins the text of errors.

    Raises:
        ModelError: a vertex further off.
    """
    size = body.element_boxes[2]
    reach = max(0.25 * size if distance is None else distance, ROUND_OFF * size)
    element, xi, off = np.full(len(points), -1), np.zeros((len(points), 3)), np.full(len(points), np.inf)
    near = 0.0
    for margin in (ROUND_OFF * size, reach / 64.0, reach / 8.0, reach):  # few candidates for most
        left = np.flatnonzero(off > near)
        near = max(margin, near)
        if len(left):
            element[left], xi[left], off[left] = _nearest(body, points[left], near)
    far = np.flatnonzero(off > reach)
    if len(far):
        raise ModelError(
            f"{what}: {len(far)} of {len(points)} vertices lie further than distance = {reach:.3g} m outside of body "
            f"{body.name!r}, the first is vertex {far[0]} at {points[far[0]].tolist()}; check scale= and transform=, "
            "or give distance="
        )
    conn = body.connectivity[element]
    s, ds = shape_at_own_points(body, element, xi)
    J0 = np.einsum("esk,esl->ekl", body.reference[conn], ds)
    rest = (points - _positions(body, element, s))[:, :, None]
    slots = s + np.einsum("esl,el->es", ds, np.linalg.solve(J0, rest)[:, :, 0])
    k = body.family.node_samples.shape[1]
    at = (body.mesh.cells[element][:, :, None] * k + np.arange(k)).reshape(len(points), -1)
    return Skin(
        triangles,
        sparse_weights(slots, conn, body.slot_count),
        sparse_weights(body.family.sample_weights(xi), at, len(body.mesh.points) * k),
        np.zeros((0, 2), dtype=np.int64),
    )


def _nearest(body: Discretisation, x: np.ndarray, margin: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Element, parent coordinates within it and distance, m, of each point (n, 3); infinite where no box enlarged by a
    margin, m, holds it."""
    low, high, size = body.element_boxes
    cubes = cKDTree(x).query_ball_point(0.5 * (low + high), 0.5 * (high - low).max(axis=1) + margin, p=np.inf)
    elements = np.repeat(np.arange(len(low)), [len(own) for own in cubes])
    points = np.concatenate([np.asarray(own, dtype=np.int64) for own in cubes])
    inside = ((low[elements] - margin <= x[points]) & (x[points] <= high[elements] + margin)).all(axis=1)
    elements, points = elements[inside], points[inside]
    xi, off = np.zeros((len(points), 3)), np.zeros(len(points))
    for first in range(0, len(points), PAIRS_AT_ONCE):
        own = slice(first, first + PAIRS_AT_ONCE)
        xi[own], off[own] = _within(body, elements[own], x[points[own]], nearest=margin > ROUND_OFF * size)
    order = np.lexsort((elements, off, points))
    chosen, at = np.unique(points[order], return_index=True)
    best = order[at]
    out = np.full(len(x), -1), np.zeros((len(x), 3)), np.full(len(x), np.inf)
    out[0][chosen], out[1][chosen], out[2][chosen] = elements[best], xi[best], off[best]
    return out


def _within(
    body: Discretisation, elements: np.ndarray, x: np.ndarray, *, nearest: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Parent coordinates (n, 3) of points x, m, within their elements, and the distances left, m; those of points
    outside are infinite, unless the `nearest` points are wanted.

    Of a point outside, a quadratic program with the metric J^T J at the last iterate: dual coordinate ascent.
    """
    xi, miss = parent_coordinates(body, elements, x)
    outside = body.family.parent.outside_distance(xi) > ROUND_OFF
    miss[outside] = np.inf
    out = np.flatnonzero(outside & nearest)
    if len(out):
        xi[out] = np.broadcast_to(body.family.parent.center, (len(out), 3))
        normal, bound = body.family.parent.sides
        for _ in range(NEWTON_STEPS):
            s, ds = shape_at_own_points(body, elements[out], xi[out])
            J = np.einsum("esk,esl->ekl", body.reference[body.connectivity[elements[out]]], ds)
            inverse = np.linalg.inv(J)
            free = xi[out] + np.einsum("elk,ek->el", inverse, x[out] - _positions(body, elements[out], s))
            push = np.einsum("elk,emk,sm->esl", inverse, inverse, normal)  # of a unit force of each side
            own = np.einsum("esl,sl->es", push, normal)
            force = np.zeros(own.shape)
            for _ in range(SWEEPS):
                for side in range(len(bound)):
                    change = np.maximum((bound[side] - free @ normal[side]) / own[:, side], -force[:, side])
                    force[:, side] += change
                    free += change[:, None] * push[:, side]
            xi[out] = free
        s, _ = shape_at_own_points(body, elements[out], xi[out])
        miss[out] = np.linalg.norm(_positions(body, elements[out], s) - x[out], axis=1)
    return xi, miss


def parent_coordinates(body: Discretisation, elements: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Parent coordinates (n, 3) of reference positions x (n, 3), m, each in its element, by Newton's method, and the
    distances left, m. Those far outside end at the limits -2 and 3."""
    E = _element_slots(body, elements)
    xi = np.tile(body.family.parent.center, (len(elements), 1))
    for _ in range(20):
        s, ds = shape_at_own_points(body, elements, xi)
        residual = np.einsum("es,esk->ek", s, E) - x
        J = np.einsum("esk,esl->ekl", E, ds)
        step = np.linalg.solve(J, residual[:, :, None])[:, :, 0]
        last, xi = xi, np.clip(xi - step, -2.0, 3.0)
        if np.abs(xi - last).max() < 1e-14:
            break
    s, _ = shape_at_own_points(body, elements, xi)
    return xi, np.asarray(np.linalg.norm(np.einsum("es,esk->ek", s, E) - x, axis=1))


def _element_slots(body: Discretisation, elements: np.ndarray) -> np.ndarray:
    """Slot values (n, S, 3) of elements in the reference, m."""
    conn = body.connectivity[elements]
    return body.reference[conn] + (body.slot_kind[conn] == 0)[:, :, None] * body.origin


def _positions(body: Discretisation, elements: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Reference positions (n, 3), m, at points of elements with functions s (n, S)."""
    return np.einsum("es,esk->ek", s, _element_slots(body, elements))


def shape_at_own_points(body: Discretisation, elements: np.ndarray, xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Functions (n, S), (n, S, 3) of elements (n,), each at its own point (n, 3)."""
    s, ds = element_functions(body, elements[:1], xi)
    if s.shape[0] == 1 and body.frames is None:
        return s[0], ds[0]
    s, ds = np.zeros(s.shape[1:]), np.zeros(ds.shape[1:])
    for element in np.unique(elements):
        own = np.flatnonzero(elements == element)
        of_element = element_functions(body, elements[own[:1]], xi[own])
        s[own], ds[own] = of_element[0][0], of_element[1][0]
    return s, ds
