"""Collected scene description of a builder, and argument checks."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any, TypeVar

import numpy as np

from ..base.errors import ModelError
from ..time_laws import Rotation, TimeLaw
from .bodies import Body
from .contacts import Collider, ContactOptions
from .handles import NodeSet, SurfaceSet
from .joints import Joint
from .springs import Bushing, Spring

__all__ = [
    "BodyForce",
    "DeadLoad",
    "Description",
    "Moment",
    "Pressure",
    "Probe",
    "Support",
    "support_slots",
]

C = TypeVar("C", bound=ContactOptions)
MAX_LISTED = 12
"""Number of bodies, joints, ... that a table names one by one."""
RODS = ("distance", "DIST")
"""Kinds of joints that keep bodies apart."""


@dataclass(eq=False)
class DeadLoad:
    """Force weight_i x value(t) on slots; used for point loads and tractions, these with their surface."""

    body: Body
    slots: np.ndarray
    weights: np.ndarray
    law: TimeLaw
    name: str
    surface: SurfaceSet | None = None


@dataclass(eq=False)
class Pressure:
    """Follower pressure on faces."""

    surface: SurfaceSet
    law: TimeLaw


@dataclass(eq=False)
class Moment:
    """Moment shared equally by K points, conjugate to the spin of vectors y_k = sum_i vectors_ik e_i of each.

    Attributes:
        slots: (K, n) body slots.
        vectors: (K, n, 3) coefficients; columns unused by the element's spin are 0.
        axes: (K, 3, 3) reference values of the vectors, columns.
    """

    body: Body
    slots: np.ndarray
    vectors: np.ndarray
    axes: np.ndarray
    law: TimeLaw


@dataclass(eq=False)
class BodyForce:
    """Field b(r, t) on bodies, N/kg."""

    function: Any
    bodies: list[Body]


@dataclass(eq=False)
class Support:
    """Prescribed components of slots: clamped (no law), moved by a law, or rotated."""

    body: Body
    slots: np.ndarray
    components: np.ndarray
    law: TimeLaw | None = None
    node_laws: list[TimeLaw] | None = None
    rotation: Rotation | None = None


@dataclass(eq=False)
class Probe:
    """A recorded point: sum of weights x slot values. Of a surface these are its integrals over its area, m^2."""

    name: str
    body: Body
    slots: np.ndarray
    weights: np.ndarray
    X: np.ndarray
    surface: SurfaceSet | None = None
    area: float = 1.0


@dataclass(eq=False)
class Description:
    """All data collected by a builder.

    Attributes:
        gravity: (3,) m/s^2, zero with `gravity_law`, a time law of it.
        up_axis: "Z" or "Y", for outputs.
    """

    bodies: list[Body] = field(default_factory=list)
    supports: list[Support] = field(default_factory=list)
    dead_loads: list[DeadLoad] = field(default_factory=list)
    pressures: list[Pressure] = field(default_factory=list)
    moments: list[Moment] = field(default_factory=list)
    body_forces: list[BodyForce] = field(default_factory=list)
    probes: list[Probe] = field(default_factory=list)
    joints: list[Joint] = field(default_factory=list)
    springs: list[Spring] = field(default_factory=list)
    bushings: list[Bushing] = field(default_factory=list)
    colliders: list[Collider] = field(default_factory=list)
    contacts: list[Any] = field(default_factory=list)
    gravity: np.ndarray = field(default_factory=lambda: np.zeros(3))
    gravity_law: TimeLaw | None = None
    up_axis: str = "Z"

    def copy(self) -> Description:
        """Copy whose lists and gravity are its own; what they hold is shared."""
        out = copy(self)
        for name, value in vars(self).items():
            if isinstance(value, (list, np.ndarray)):
                setattr(out, name, copy(value))
        return out

    def contacts_of(self, kind: type[C]) -> list[C]:
        """Contacts of one class, as `Contact` with colliders or `PairContact` between bodies, and those of edges."""
        both = [part for contact in self.contacts for part in (contact, contact.edges)]
        return [contact for contact in both if isinstance(contact, kind)]

    @property
    def contact_pairs(self) -> dict[frozenset[int], list[Any]]:
        """Contacts by the identities of both sides, bodies or colliders."""
        out: dict[frozenset[int], list[Any]] = {}
        for c in self.contacts:
            out.setdefault(frozenset(map(id, c.sides)), []).append(c)
        return out

    @property
    def attached_pairs(self) -> set[frozenset[int]]:
        """Identities of each two bodies that a weld, a joint or a constraint connects, but for those of a rod."""
        out: set[frozenset[int]] = set()
        for joint in self.joints:
            vectors = (v for row in joint.rows if joint.kind not in RODS for v in row.vectors)
            bodies = {id(part.body) for vector in vectors for part in vector.parts}
            out |= {frozenset(pair) for pair in combinations(sorted(bodies), 2)}
        return out

    def clamped_slots(self, body: Body) -> np.ndarray:
        """Mask (slots,) of the slots of a body clamped in all directions by supports that never move."""
        held = np.zeros((body.slot_count, 3))
        for support in self.supports:
            fixed = support.law is None and support.node_laws is None and support.rotation is None
            if support.body is body and fixed:
                held[support.slots] += support.components
        return np.asarray((held > 0).all(axis=1))

    def table(self) -> dict[str, str]:
        """Readable contents by name: each of a few bodies, and the names or numbers of all else."""
        few = len(self.bodies) <= MAX_LISTED
        rows = {f"body {body.name}": repr(body) for body in self.bodies} if few else {"bodies": str(len(self.bodies))}
        for name in ("joints", "springs", "colliders", "contacts", "probes"):
            things = getattr(self, name)
            names = [str(getattr(thing, "name", "")) for thing in things]
            rows[name] = ", ".join(names) if 0 < len(names) <= MAX_LISTED and all(names) else str(len(names) or "")
        loads = len(self.dead_loads) + len(self.pressures) + len(self.moments) + len(self.body_forces)
        rows |= {"supports": str(len(self.supports) or ""), "loads": str(loads or "")}
        if self.gravity.any():
            rows["gravity"] = f"({', '.join(f'{g:.4g}' for g in self.gravity)}) m/s^2"
        return rows

    def summary(self) -> str:
        """One-line summary; "" for an empty description."""
        loads = len(self.dead_loads) + len(self.pressures) + len(self.moments) + len(self.body_forces)
        counts = {"support": len(self.supports), "load": loads, "joint": len(self.joints)}
        counts |= {
            "spring": len(self.springs),
            "collider": len(self.colliders),
            "contact": len(self.contacts),
            "probe": len(self.probes),
        }
        parts = [repr(body) for body in self.bodies] if len(self.bodies) <= 3 else [f"{len(self.bodies)} bodies"]
        return ", ".join(parts + [f"{n} {what}{'s' * (n > 1)}" for what, n in counts.items() if n])


def every_slot_of_rigid(nodes: NodeSet) -> np.ndarray:
    """The four slots of a rigid part held by nodes. Raises ModelError for nodes on one line: it could turn."""
    X = nodes.body.mesh.points[nodes.indices]
    spread = np.linalg.svd(X - X.mean(axis=0), compute_uv=False)
    if len(X) < 3 or not spread[1] > 1e-6 * spread[0]:
        raise ModelError(
            f"rigid part {nodes.body.name!r}: {len(X)} nodes on one line do not hold it: take three nodes or more, or "
            "add_joint('spherical' or 'revolute', parent=wf.GROUND, child=part.at(X)), which lets it turn"
        )
    return np.arange(4)


def support_slots(nodes: NodeSet, which: str) -> np.ndarray:
    """Body slots of a node set, of the named kinds (see Family.kinds)."""
    body = nodes.body
    try:
        kinds = body.family.slot_kinds_of(which)
    except ModelError as error:
        raise ModelError(f"body {body.name!r}: {error}") from None
    if body.rigid:
        return every_slot_of_rigid(nodes)
    first = body.node_slot[nodes.indices]
    first = first[first >= 0]
    if not len(first):
        return first
    counts = body.node_slot_count[body.slot_node[first]]
    every = np.concatenate([f + np.arange(c) for f, c in zip(first, counts)])
    return every[np.isin(body.slot_kind[every], sorted(kinds))]
