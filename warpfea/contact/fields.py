"""Nodal contact fields of a body: pressure and gap, for obstacles and other bodies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from ..model.discretisation import Discretisation, element_functions
from ..terms.term import FieldSpec
from .collider_tables import ContactTables

if TYPE_CHECKING:
    from .facet_tables import PairTables

__all__ = [
    "CONTACT_FIELDS",
    "BodyContactPoints",
    "contact_field",
    "nearest_samples",
    "nodal_force",
    "obstacle_contact_points",
]

CONTACT_FIELDS = {
    "contact_pressure": FieldSpec("contact pressure", "Pa", np.add, np.maximum),
    "gap": FieldSpec("gap", "m", np.fmin, np.fmin),
}
"""Fields of both contact terms: pressures add up, the smallest gap counts."""


@dataclass(frozen=True, eq=False)
class BodyContactPoints:
    """Contact points of a body, each (worlds, points).

    Attributes:
        nearest: sample of the body nearest to a point, -1: none.
        area: represented area, m^2. normal: elastic normal force, N. gap: m, 1e30 if unknown.
    """

    nearest: np.ndarray
    area: np.ndarray
    normal: np.ndarray
    gap: np.ndarray


def contact_field(name: str, body: Any, worlds: int, contact_points: list[BodyContactPoints]) -> np.ndarray:
    """Field "contact_pressure" or "gap" (worlds, nodes x samples) at the samples of each node of a body.

    Every contact point is assigned to the sample closest to it in the reference. Pressure is the elastic normal force
    on a sample's points over their area; several contacts add up. Gap is the minimum over the points, NaN for a sample
    without points.
    """
    nodes = len(body.mesh.points) * body.family.node_samples.shape[1]
    pressure, least = np.zeros((worlds, nodes)), np.full((worlds, nodes), np.inf)
    for patch in contact_points:
        for world in range(worlds):
            known = patch.nearest[world] >= 0
            at = patch.nearest[world, known]
            area, total = (
                np.bincount(at, weights=x[world, known], minlength=nodes) for x in (patch.area, patch.normal)
            )
            pressure[world] += np.divide(total, area, out=np.zeros(nodes), where=area > 0.0)
            np.minimum.at(least[world], at, patch.gap[world, known])
    # unassigned points have a gap of 1e30
    return pressure if name == "contact_pressure" else np.where(least < 1e29, least, np.nan)


def obstacle_contact_points(
    t: ContactTables, body: Any, gap: np.ndarray, normal: np.ndarray
) -> list[BodyContactPoints]:  # fmt: skip
    """Contact points of a body with obstacles, from gaps and elastic normal forces of all points."""
    out = []
    for k, contact in enumerate(t.contacts):
        if contact.body is body:
            points = slice(t.first[k], t.first[k + 1])
            nearest, area = nearest_samples(t, k, body), t.host[k].area.ravel()
            shape = gap[:, points].shape
            out.append(BodyContactPoints(np.broadcast_to(nearest, shape), np.broadcast_to(area, shape),
                                         normal[:, points], gap[:, points]))  # fmt: skip
    return out


def nearest_samples(
    t: ContactTables | PairTables, k: int, body: Discretisation, X: np.ndarray | None = None
) -> np.ndarray:  # fmt: skip
    """Sample index (points,) of the body nearest to the reference positions X (points, 3).

    By default the points of contact k and the nodes of its facets.
    """
    key = f"{type(t).__name__} {k} samples {body.name}"
    if key not in t.model.cache:
        count = body.family.node_samples.shape[1]
        nodes = np.asarray(body.mesh.used_nodes)
        if X is None:
            p = t.host[k]
            used = np.zeros(body.slot_count, dtype=bool)
            used[p.conn[np.any(np.abs(p.shape) > 1e-12, axis=1)]] = True
        else:
            used = _surface_slots(body)
        nodes = nodes[used[body.node_slot[nodes]]]
        samples = (nodes[:, None] * count + np.arange(count)).ravel()
        tree = cKDTree(_sample_positions(body)[samples])
        fixed = None if X is not None else samples[tree.query(t.host[k].X.reshape(-1, 3))[1]]
        t.model.cache[key] = (samples, tree, fixed)
    samples, tree, fixed = t.model.cache[key]
    return fixed if X is None else samples[tree.query(X)[1]]


def _surface_slots(body: Discretisation) -> np.ndarray:
    """Mask (slots,) of slots on an outer face."""
    out = np.zeros(body.slot_count, dtype=bool)
    for face in np.unique(body.boundary[:, 1]):
        xi, _ = body.family.face_points(int(face), np.array([(0.25, 0.25), (0.5, 0.25), (0.25, 0.5)]))
        rows = body.boundary[body.boundary[:, 1] == face, 0]
        shape, _ = element_functions(body, rows, xi)
        used = np.any(np.abs(np.broadcast_to(shape, (len(rows), *shape.shape[1:]))) > 1e-12, axis=1)
        out[body.connectivity[rows][used]] = True
    return out


def _sample_positions(body: Discretisation) -> np.ndarray:
    """Reference positions (nodes x samples, 3), m; NaN for nodes without an element."""
    samples = body.family.node_samples
    cells = np.asarray(body.mesh.cells)
    s, _ = element_functions(body, np.arange(len(cells)), samples.reshape(-1, 3))
    X = np.einsum("eps,esk->epk", np.broadcast_to(s, (len(cells), *s.shape[1:])), body.reference[body.connectivity])
    out = np.full((len(body.mesh.points) * samples.shape[1], 3), np.nan)
    out[(cells[:, :, None] * samples.shape[1] + np.arange(samples.shape[1])).reshape(len(cells), -1)] = X + body.origin
    return out


def nodal_force(tables: ContactTables | PairTables, force: np.ndarray) -> np.ndarray:
    """Nodal forces (worlds, slots, 3), N, from point forces (worlds, points, 3)."""
    out = np.zeros((len(force), tables.model.slots, 3))
    bodies = [contact.body for contact in tables.contacts]
    for k, (body, p) in enumerate(zip(bodies, tables.host)):
        at_point = force[:, tables.first[k] : tables.first[k + 1]].reshape(-1, *p.area.shape, 3)
        at_slot = np.einsum("bfpk,fpl->bflk", at_point, p.shape)
        for world in range(len(force)):
            np.add.at(out[world], p.conn + body.slot_offset, at_slot[world])
    return out
