"""Tables of contacts and colliders on the device, and the numbers of their laws."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from scipy.optimize import brentq

from ..base.errors import ModelError
from ..kernels.terms.contact_data import contact_struct, facet_struct
from ..kernels.terms.contact_laws import DEFAULT, PAPER, SMOOTH
from ..model.contact_points import (
    RULES,
    ContactPoints,
    body_mass_total,
    contact_points,
    effective_modulus,
    lagrange_basis,
)
from ..model.contacts import Collider, Contact
from ..model.triangle_mesh import TriMesh
from .collider_meshes import mesh_tables, sizes
from .time_laws import TimeLaws

if TYPE_CHECKING:
    from ..base.launch import Launcher
    from ..model.model import Model

__all__ = ["PER_WORLD", "ContactTables", "FacetGroup", "beta_of", "block_entries", "hunt_crossley_damping"]

LAWS = {"default": DEFAULT, "paper": PAPER, "smooth": SMOOTH}
SMOOTHING = (1e-3, 1e-4)
"""Of the smooth law where none is given: eps, N, and v_eps, m/s."""
PER_WORLD = {"mu": "mu", "mu_static": "mu_static", "restitution": "damping", "stiffness": "scale"}
"""What Model.set_parameter sets of a contact, and the arrays with it; the restitution is in `beta` too."""
PATCH, LUMPED, MOVING = range(3)
"""What acts on a facet: all of its points, at most one of them, at most one place of it."""
CONSTANT = 2.0 * math.sqrt(5.0 / 6.0)


def beta_of(restitution: float) -> float:
    """-beta of Eq. (75), positive."""
    log = math.log(restitution)
    return -log / math.hypot(log, math.pi)


def hunt_crossley_damping(restitution: float) -> float:
    """chi v_i of the default law: the d of (1 + e) d = ln((1 + d)/(1 - e d)), 0 for e = 1.

    Exact for an impact of a mass on the undamped-at-rest spring, whatever its exponent; DESIGN 8.
    """
    e = restitution
    if e >= 1.0:
        return 0.0

    def excess(d: float) -> float:
        return (1.0 + e) * d - math.log1p(d) + math.log1p(-e * d)

    top = 1.0 / e
    low = 1e-9
    while excess(low) <= 0.0 and low < 0.5 * top:  # rounding, for e close to 1
        low *= 2.0
    high = top * (1.0 - 1e-15)
    if excess(low) <= 0.0:
        return 0.0
    # below e of about 0.02 the root is nearer to 1/e than numbers can be
    return float(brentq(excess, low, high, xtol=1e-15)) if excess(high) < 0.0 else high


def clamped_slots(model: Model) -> np.ndarray:
    """(slots,) whether a slot is held in all directions by supports that never move."""
    held = np.zeros((model.slots, 3))
    for support in model.description.supports:
        if support.law is None and support.node_laws is None and support.rotation is None:
            held[support.body.slot_offset + support.slots] += support.components
    return np.asarray((held > 0).all(axis=1))


LISTED = 8
"""Threads that share a sum over the points of a facet on CUDA."""


@dataclass(eq=False)
class FacetGroup:
    """Facets with as many slots and points each, those of a contact next to each other.

    Attributes:
        conn: (F, L) slots of the model.
        points: (F, P) numbers of the points.
        data: the device struct.
        lumped: whether at most one of its places acts.
    """

    conn: np.ndarray
    data: Any
    lumped: bool

    @property
    def count(self) -> int:
        """Facets."""
        return len(self.conn)

    def sides(self, launch: Launcher, worlds: int) -> tuple[tuple[int, int], int]:
        """Threads that sum over the points of a facet for each of its slots, and how many share a slot."""
        lanes = launch.lanes(LISTED)
        return (worlds, launch.padded(lanes * self.conn.size)), lanes


class ContactTables:
    """Contacts and colliders of a model, in the order of the device: by the kind of their facets.

    Attributes:
        contacts: handles in that order; number: of a handle's index.
        groups: facets.
        points, rows: how many there are in all.
        left_out: how many points of each contact only move with clamped slots, and so do not count.
        host: shape functions, areas, slots and places of each contact, for fields and checks.
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        self.colliders: list[Collider] = list(model.description.colliders)
        found = [(contact, contact_points(contact.surface, contact.points)) for contact in model.description.contacts]
        kinds = sorted({_kind(contact, p) for contact, p in found})
        order = sorted(range(len(found)), key=lambda k: (kinds.index(_kind(*found[k])), k))
        self.contacts: list[Contact] = [found[k][0] for k in order]
        self.host: list[ContactPoints] = [found[k][1] for k in order]
        self.number = {contact.index: k for k, contact in enumerate(self.contacts)}
        self.clamped = clamped_slots(model)
        self.left_out: list[int] = []
        self.shares = [self._share(c, p) for c, p in zip(self.contacts, self.host)]
        self.groups: list[FacetGroup] = []
        self.kinds = kinds
        self.points = self.rows = 0

    @property
    def lumped(self) -> bool:
        """Whether a contact acts at its deepest point alone."""
        return any(contact.model == "sphere" for contact in self.contacts)

    @property
    def moving(self) -> bool:
        """Whether a contact acts at its deepest place, wherever that is on its facets."""
        return any(group.data.moving for group in self.groups)

    @property
    def meshes(self) -> bool:
        """Whether a collider is a mesh of triangles."""
        return any(isinstance(collider.shape, TriMesh) for collider in self.colliders)

    @property
    def sheets(self) -> bool:
        """Whether one of these has no inside."""
        return any(isinstance(k.shape, TriMesh) and not k.shape.closed for k in self.colliders)

    @property
    def explicit(self) -> bool:
        """Whether a contact has the force of the last state."""
        return any(contact.treatment == "explicit" for contact in self.contacts)

    def _share(self, contact: Contact, p: ContactPoints) -> np.ndarray:
        """(F, P) area of each point over that of the region; 0 where it only moves with clamped slots."""
        slots = p.conn + contact.body.slot_offset
        moves = np.any((np.abs(p.shape) > 1e-12) & ~self.clamped[slots][:, None, :], axis=2)
        used = moves & (p.area > 0.0)
        self.left_out.append(int((~used & (p.area > 0.0)).sum()))
        if not used.any():
            raise ModelError(
                f"contact {contact.name!r}: all points of the surface of body {contact.body.name!r} are clamped; "
                "choose another surface, or leave the contact out"
            )
        if contact.model == "sphere":
            return used.astype(float)
        region = math.pi * contact.radius**2 if contact.radius else float(p.area.sum())
        return np.where(used, p.area / region, 0.0)

    def build(self, laws: TimeLaws, pool: int) -> None:
        """Upload; `pool`: the first entry of the term in the pool."""
        entries = 0
        first = np.zeros(len(self.contacts) + 1, dtype=np.int64)
        self.row_start = np.zeros(len(self.contacts) + 1, dtype=np.int64)
        for kind in self.kinds:
            chosen = [k for k, pair in enumerate(zip(self.contacts, self.host)) if _kind(*pair) == kind]
            for k in chosen:
                first[k + 1] = first[k] + self.host[k].area.size
                self.row_start[k + 1] = self.row_start[k] + len(self.host[k].conn)
            group = self._group(chosen, pool + entries)
            self.groups.append(group)
            entries += group.conn.size
            self.rows += group.count
            self.points += group.count * kind[1]
        self.first = first
        self.data = self._contacts(laws)

    def _group(self, chosen: list[int], pool: int) -> FacetGroup:
        m = self.model
        offset = [self.contacts[k].body.slot_offset for k in chosen]
        conn = np.concatenate([self.host[k].conn + o for k, o in zip(chosen, offset)])
        data = facet_struct(m.dtype)()

        def put(name: str, values: Any, dtype: Any) -> None:
            setattr(data, name, m.array("contact", np.ascontiguousarray(values), dtype))

        parts = [self.host[k] for k in chosen]
        put("conn", conn.T, wp.int32)
        put("shape", np.moveaxis(np.concatenate([p.shape for p in parts]), 0, 2), m.types.T)
        put("X", np.swapaxes(np.concatenate([p.X for p in parts]), 0, 1), wp.vec3d)
        put("share", np.concatenate([self.shares[k] for k in chosen]).T, wp.float64)
        put("area", np.concatenate([p.area for p in parts]).T, wp.float64)
        put("contact", np.repeat(chosen, [len(p.conn) for p in parts]), wp.int32)
        data.pool, data.row, data.point = pool, self.rows, self.points
        data.count, data.points = len(conn), parts[0].area.shape[1]
        kind = _kind(self.contacts[chosen[0]], parts[0])[2]
        data.moving, data.corners = int(kind == MOVING), 3 if data.points in RULES[3] else 4
        if kind != PATCH:
            points = RULES[data.corners][data.points].points
            basis, power = lagrange_basis(points)
            put("coords", points, wp.vec2d)
            put("basis", basis, wp.float64)
            put("power", power, wp.vec2i)
        return FacetGroup(conn, data, kind != PATCH)

    def _contacts(self, laws: TimeLaws) -> Any:
        m, C, K = self.model, self.contacts, self.colliders
        out = contact_struct(self.meshes)()

        def put(name: str, values: Any, dtype: Any) -> None:
            setattr(out, name, m.array("contact", np.asarray(values), dtype))

        numbers = [law_numbers(c) for c in C]
        put("collider", [K.index(c.collider) for c in C], wp.int32)
        put("law", [LAWS[c.law] for c in C], wp.int32)
        put("lumped", [int(c.model == "sphere") for c in C], wp.int32)
        put("dead", [int(c.treatment == "explicit") for c in C], wp.int32)
        put("first", self.first, wp.int32)
        for name in ("normal", "tangent", "normal_damping", "mass", "ramp", "force_eps", "speed_eps"):
            put(name, [row[name] for row in numbers], wp.float64)
        put("offset", [c.offset for c in C], wp.float64)
        put("decay", [c.overlap_time for c in C], wp.float64)
        per_world = {
            "mu": [c.mu for c in C],
            "mu_static": [c.mu_static for c in C],
            "damping": [hunt_crossley_damping(c.restitution) for c in C],
            "beta": [beta_of(c.restitution) for c in C],
            "scale": [c.stiffness for c in C],
            "grow": [0.0 for _ in K],
        }
        for name, values in per_world.items():
            put(name, np.tile(values, (m.worlds, 1)), wp.float64)
        frames = [k.shape.frame() for k in K]
        put("kind", [k.shape.kind for k in K], wp.int32)
        put("size", [sizes(k.shape, self._touching(k)) for k in K], wp.vec3d)
        put("center", [center for center, _ in frames], wp.vec3d)
        put("axes", [axes for _, axes in frames], wp.mat33d)
        put("path", [laws.add(k.law) if k.law is not None else -1 for k in K], wp.int32)
        put("spin", [laws.add(k.rotation.angle) if k.rotation is not None else -1 for k in K], wp.int32)
        put("anchor", [k.rotation.anchor if k.rotation else np.zeros(3) for k in K], wp.vec3d)
        put("axis", [k.rotation.axis if k.rotation else (0.0, 0.0, 1.0) for k in K], wp.vec3d)
        if self.meshes:
            out.mesh = mesh_tables(m, [k.shape for k in K])
        return out

    def _touching(self, collider: Collider) -> list[np.ndarray]:
        """Points of the surfaces that may touch a collider, (n, 3), m."""
        return [p.X.reshape(-1, 3) for c, p in zip(self.contacts, self.host) if c.collider is collider]

    def hash(self, h: Any) -> None:
        """Feed what defines the contacts into a hash."""
        for collider in self.colliders:
            center, axes = collider.shape.frame()
            h.update(f"{collider.name} {collider.shape.kind}".encode())
            h.update(np.concatenate([collider.shape.sizes, center, axes.ravel()]).tobytes())
            if isinstance(collider.shape, TriMesh):
                h.update(collider.shape.points.tobytes() + collider.shape.triangles.tobytes())
            if collider.rotation is not None:
                h.update(np.concatenate([collider.rotation.anchor, collider.rotation.axis]).tobytes())
        for contact, p in zip(self.contacts, self.host):
            fixed = ("surface", "collider", *PER_WORLD)
            values = {k: v for k, v in vars(contact).items() if k not in fixed}
            h.update(f"{contact.collider.name} {sorted(values.items())}".encode())
            h.update(np.ascontiguousarray(p.faces).tobytes())
        for name in (*PER_WORLD.values(), "beta", "grow"):
            h.update(getattr(self.data, name).numpy().tobytes())


def _kind(contact: Contact, p: ContactPoints) -> tuple[int, int, int]:
    """Slots and points of a facet, and what acts: PATCH, LUMPED or MOVING."""
    lumped = LUMPED if contact.treatment == "explicit" else MOVING
    return p.conn.shape[1], p.area.shape[1], PATCH if contact.model == "patch" else lumped


def law_numbers(contact: Contact) -> dict[str, float]:
    """Constants of Eqs. (74)-(76), (79) and (80) with a rigid obstacle; of lumped contacts over powers of the depth."""
    E, nu = effective_modulus(contact.body, contact.surface)
    modulus = E / (1.0 - nu**2)
    shear = E / (2.0 * (1.0 + nu)) / (2.0 - nu)
    mass = body_mass_total(contact.body)
    if contact.model == "sphere":
        # 1/R_eff = 1/R_A + 1/R_B, with a = sqrt(R_eff depth)
        assert contact.radius is not None
        a = math.sqrt(1.0 / (1.0 / contact.radius + 1.0 / contact.collider.shape.radius_of_curvature))
    elif contact.radius:
        a = contact.radius
    else:
        a = math.sqrt(float(contact_points(contact.surface, contact.points).area.sum()) / math.pi)
    smoothing = contact.smoothing
    pair = smoothing if isinstance(smoothing, tuple) else SMOOTHING
    return {
        "normal": 4.0 / 3.0 * modulus * a,
        "tangent": 8.0 * shear * a,
        "normal_damping": CONSTANT * math.sqrt(2.0 * modulus * a * mass),
        "mass": mass,
        "ramp": float(smoothing) if isinstance(smoothing, (int, float)) else 0.0,
        "force_eps": pair[0],
        "speed_eps": pair[1],
    }


def block_entries(model: Model, conn: np.ndarray, pattern: Any) -> tuple[wp.array, wp.array, wp.array, int]:
    """Entries of the pattern that facets add to: which, where their items begin, and (facet, slot, slot)."""
    a, b = (x.ravel() for x in np.indices((conn.shape[1],) * 2))
    facet = np.repeat(np.arange(len(conn)), len(a))
    a, b = np.tile(a, len(conn)), np.tile(b, len(conn))
    index = pattern.find(conn[facet, a], conn[facet, b])
    chosen = np.flatnonzero(index >= 0)
    chosen = chosen[np.argsort(index[chosen], kind="stable")]
    entry, count = np.unique(index[chosen], return_counts=True)
    source = np.stack([facet[chosen], a[chosen], b[chosen]], axis=1)
    start = np.concatenate([[0], np.cumsum(count)])
    arrays = (model.array("contact", x, t) for x, t in ((entry, wp.int32), (start, wp.int32), (source, wp.vec3i)))
    return (*arrays, len(entry))  # type: ignore[return-value]
