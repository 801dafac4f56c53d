"""Contact as fields at the nodes of a body: pressure and gap."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ..kernels.terms.contact_laws import SMOOTH
from ..model.discretisation import Discretisation, element_functions
from .contact_tables import LAWS, ContactTables

__all__ = ["contact_field", "nodal_force"]


def contact_field(
    t: ContactTables, name: str, body: Any, worlds: int, at_points: Callable[[], tuple[np.ndarray, np.ndarray]]
) -> np.ndarray:
    """(worlds, nodes x samples) "contact_pressure" or "gap" at the samples of each node of a body.

    Every contact point counts at the sample closest to it in the reference. Pressure is the elastic normal force of a
    sample's points over the area that they stand for; of several contacts it adds up. Gap is the smallest of the
    points, NaN where a sample has none. `at_points` gives gaps and forces of all points.
    """
    mine = [k for k, contact in enumerate(t.contacts) if contact.body is body]
    nodes = len(body.mesh.points) * body.family.node_samples.shape[1]
    pressure, least = np.zeros((worlds, nodes)), np.full((worlds, nodes), np.inf)
    if mine:
        gap, force = at_points()
    for k in mine:
        points = slice(t.first[k], t.first[k + 1])
        nearest = _nearest(t, k)
        area = np.bincount(nearest, weights=t.host[k].area.ravel(), minlength=nodes)
        normal = _normal_force(t, k, gap[:, points], force[:, points])
        for world in range(worlds):
            total = np.bincount(nearest, weights=normal[world], minlength=nodes)
            pressure[world] += np.divide(total, area, out=np.zeros(nodes), where=area > 0.0)
            np.minimum.at(least[world], nearest, gap[world, points])
    # points that do not count have a gap of 1e30
    return pressure if name == "contact_pressure" else np.where(least < 1e29, least, np.nan)


def _normal_force(t: ContactTables, k: int, gap: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Elastic normal force, N, on the points (worlds, points) of a contact, from their gaps, without friction."""
    contact = t.contacts[k]
    stiffness = t.data.scale.numpy()[:, k, None] * t.data.normal.numpy()[k]
    share = t.shares[k].ravel()
    depth = np.where(share > 0.0, -gap, 0.0)
    if contact.model == "sphere":
        deepest = np.arange(depth.shape[1]) == depth.argmax(axis=1)[:, None]
        return np.where(deepest & force.any(axis=2), stiffness * np.maximum(depth, 0.0) ** 1.5, 0.0)
    if LAWS[contact.law] == SMOOTH:
        y = stiffness * depth
        return share * 0.5 * (y + np.hypot(y, t.data.force_eps.numpy()[k]))
    return share * stiffness * np.maximum(depth, 0.0)


def _nearest(t: ContactTables, k: int) -> np.ndarray:
    """(points,) the sample that each point of a contact counts at."""
    key = f"contact {k} samples"
    if key not in t.model.cache:
        p, body = t.host[k], t.contacts[k].body
        used = np.zeros(body.slot_count, dtype=bool)
        used[p.conn[np.any(np.abs(p.shape) > 1e-12, axis=1)]] = True
        count = body.family.node_samples.shape[1]
        nodes = np.asarray(body.mesh.used_nodes)
        nodes = nodes[used[body.node_slot[nodes]]]
        samples = (nodes[:, None] * count + np.arange(count)).ravel()
        tree = cKDTree(_sample_places(body)[samples])
        t.model.cache[key] = samples[tree.query(p.X.reshape(-1, 3))[1]]
    return t.model.cache[key]


def _sample_places(body: Discretisation) -> np.ndarray:
    """(nodes x samples, 3) reference places, m; NaN of nodes without an element."""
    samples = body.family.node_samples
    cells = np.asarray(body.mesh.cells)
    s, _ = element_functions(body, np.arange(len(cells)), samples.reshape(-1, 3))
    X = np.einsum("eps,esk->epk", np.broadcast_to(s, (len(cells), *s.shape[1:])), body.reference[body.connectivity])
    out = np.full((len(body.mesh.points) * samples.shape[1], 3), np.nan)
    out[(cells[:, :, None] * samples.shape[1] + np.arange(samples.shape[1])).reshape(len(cells), -1)] = X + body.origin
    return out


def nodal_force(tables: ContactTables, force: np.ndarray) -> np.ndarray:
    """Forces on slots (worlds, slots, 3), N, of forces on points (worlds, points, 3)."""
    out = np.zeros((len(force), tables.model.slots, 3))
    for k, (contact, p) in enumerate(zip(tables.contacts, tables.host)):
        at_point = force[:, tables.first[k] : tables.first[k + 1]].reshape(-1, *p.area.shape, 3)
        at_slot = np.einsum("bfpk,fpl->bflk", at_point, p.shape)
        for world in range(len(force)):
            np.add.at(out[world], p.conn + contact.body.slot_offset, at_slot[world])
    return out
