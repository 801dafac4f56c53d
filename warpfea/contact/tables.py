"""Tables common to contact with colliders and between bodies: groups of facets with their points, law constants,
parameters per world for Model.set_parameter."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np
import warp as wp
from scipy.optimize import brentq

from ..base.worlds import check_values_per_world, set_rows, values_per_world
from ..kernels.contact.law import LAWS, law_code, own_laws
from ..kernels.contact.structs import facet_struct
from ..model.contact_points import (
    CONTACT_RULES,
    ContactPoints,
    Modulus,
    body_mass_total,
    corner_points,
    effective_modulus,
    lagrange_basis,
)
from ..model.contacts import Contact, ContactOptions
from ..model.discretisation import Discretisation
from ..model.pairs import FacetOptions

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = [
    "MATERIAL_CONSTANTS", "POINT_SUM_LANES", "TOUCHING_DEPTH_RATIO", "WORLD_PARAMETERS", "FacetTables", "bodies_of",
    "check_chosen_values", "clamped_slots", "contact_constants", "hunt_crossley_damping", "normal_damping",
    "restitution_beta", "restitution_slopes", "speed_damping",
]  # fmt: skip

AnyContact = TypeVar("AnyContact", Contact, FacetOptions)
DEFAULT_SMOOTHING = (1e-3, 1e-4)
"""Default eps, N, and v_eps, m/s, of the smooth law."""
WORLD_PARAMETERS = {"mu": "mu", "mu_static": "mu_static", "restitution": "damping", "stiffness": "scale"}
"""Contact parameters of Model.set_parameter and their arrays; the restitution also sets `beta`."""
RIGID_DAMPING = 5.0
"""Damping of rigid parts with restitution 0 over the critical one: 1 % of the speed is returned, 13.5 % with 1."""
MATERIAL_CONSTANTS = ("normal_stiffness", "tangential_stiffness", "normal_damping", "effective_mass", "compliance")
"""Contact constants derived from the bodies' materials."""
TOUCHING_DEPTH_RATIO = 1e-9
"""Depth over the model's size treated as touching at the start of a step; to that of a run round-off is added."""
POINT_SUM_LANES = 8
"""Largest number of threads that share a sum over the points of a facet on CUDA."""
ELEMENT_STIFFNESS = 10.0
"""Stiffness of a contact over that of the elements that touch: it is a tenth of their compression deep."""
PATCH, LUMPED, MOVING = range(3)
"""Contact kinds of a facet: all points, at most one point, or at most one moving position."""
VALID_RANGES = {  # for error texts
    "mu": "a friction coefficient, 0 or above",
    "mu_static": "at least mu",
    "restitution": "from 0 to 1",
    "stiffness": "a positive factor",
    "offset": "a finite number, m",
}


def restitution_beta(restitution: float) -> float:
    """-beta of Eq. (75), positive; 1 for 0."""
    if restitution == 0.0:
        return 1.0
    log = math.log(restitution)
    return -log / math.hypot(log, math.pi)


def hunt_crossley_damping(restitution: float) -> float:
    """chi v_i of the default law: the d of (1 + e) d = ln((1 + d)/(1 - e d)), 0 for e = 1; -1 for e = 0, see
    `default_law`.

    Exact for the impact of a mass on the spring, undamped at rest, for any exponent.
    """
    e = restitution
    if e >= 1.0 or e <= 0.0:
        return e - 1.0 if e <= 0.0 else 0.0

    def excess(d: float) -> float:
        return (1.0 + e) * d - math.log1p(d) + math.log1p(-e * d)

    top = 1.0 / e
    low = 1e-9
    while excess(low) <= 0.0 and low < 0.5 * top:  # round-off, for e close to 1
        low *= 2.0
    high = top * (1.0 - 1e-15)
    if excess(low) <= 0.0:
        return 0.0
    # below e of about 0.02 the root is within round-off of 1/e
    return float(brentq(excess, low, high, xtol=1e-15)) if excess(high) < 0.0 else high


def restitution_slopes(damping: np.ndarray, beta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of `hunt_crossley_damping` and `restitution_beta` by the restitution, from both; NaN at 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        log = -math.pi * beta / np.sqrt(1.0 - beta**2)
        e = np.exp(log)
        slope = e * damping * (1.0 + damping) / ((1.0 + e) * (1.0 - e - e * damping))
        of_beta = -(math.pi**2) / e / np.hypot(log, math.pi) ** 3
    return np.where(e == 1.0, -1.5, np.where(e > 0.0, slope, np.nan)), np.where(e > 0.0, of_beta, np.nan)


def speed_damping(contact: ContactOptions, restitution: float) -> float:
    """chi v_i of the default law; of restitution 0 minus the damping over the critical one."""
    rigid = not any(surface.body.elastic for surface in contact.surfaces)
    return hunt_crossley_damping(restitution) * (RIGID_DAMPING if rigid and restitution == 0.0 else 1.0)


def compliance(contact: ContactOptions, stiffness: float, area: float, *compliances: float) -> tuple[float, ...]:
    """Coefficients of `stiffness_ratio` (kernels/contact/kinematics.py): 1 and zeros for one stiffness of the region.

    Args:
        stiffness: k_n of the region, N/m.
        area: of the region, m^2.
        compliances: (1 - nu^2)/E of the side of the points and of the other one, 1/Pa.
    """
    if contact.stiffness_of == "region":
        return 1.0, 0.0, 0.0
    return 0.0, *(stiffness * c / (ELEMENT_STIFFNESS * area) for c in compliances)


def contact_constants(
    contact: ContactOptions, area: float | None = None,
    mass_of: Callable[[Discretisation], float] = body_mass_total, modulus_of: Modulus = effective_modulus,
) -> dict[str, Any]:  # fmt: skip
    """Constants `MATERIAL_CONSTANTS` of a region of `area`, m^2, Eqs. (74)-(76), (79), (80); an obstacle is rigid.

    k_n = 4/3 E* a, k_t = 8 G* a, N/m, with area = pi a^2; of single-point contacts over powers of the depth.
    """
    shear_compliance = inverse_mass = 0.0
    compliances = []
    yields = [surface.body.elastic for surface in contact.surfaces]
    for surface in contact.surfaces:
        total = mass_of(surface.body)
        inverse_mass += 1.0 / total if total > 0.0 else math.inf
        if any(yields) and not surface.body.elastic:
            compliances.append(0.0)
            continue
        E, nu = modulus_of(surface.body, surface)
        compliances.append((1.0 - nu**2) / E)
        shear_compliance += 2.0 * (2.0 - nu) * (1.0 + nu) / E
    if contact.grounded:
        compliances.insert(int(contact.sign > 0.0), 0.0)
    area = contact.region_area(contact.slave_points()[0]) if area is None else area
    a, total = math.sqrt(area / math.pi), sum(compliances)
    stiffness, mass = 4.0 / 3.0 * a / total, 1.0 / inverse_mass
    return {
        "normal_stiffness": stiffness,
        "compliance": compliance(contact, stiffness, area, *compliances),
        "tangential_stiffness": 8.0 * a / shear_compliance,
        "normal_damping": normal_damping(2.0 * a / total, mass),
        "effective_mass": mass,
    }


def normal_damping(stiffness: float, mass: float) -> float:
    """gamma_n over -beta of Eq. (76), N s/m, for S_n = 2 E* a in N/m and m_eff in kg."""
    return 2.0 * math.sqrt(5.0 / 6.0) * math.sqrt(stiffness * mass)


def clamped_slots(model: Model) -> np.ndarray:
    """Mask (slots,) of slots clamped in all directions by supports that never move."""
    out = np.zeros(model.slots, dtype=bool)
    for body in model.bodies:
        out[body.slot_range] = model.description.clamped_slots(body)
    return out


@dataclass(eq=False)
class FacetGroup:
    """Facets with equal numbers of slots and points; those of a contact are contiguous.

    Attributes:
        conn: (F, L) model slots.
        points: (F, P) point indices.
        data: device struct.
        lumped: True if at most one position of a facet acts.
        contacts: in device order.
    """

    conn: np.ndarray
    data: Any
    lumped: bool
    contacts: list[int]

    @property
    def count(self) -> int:
        """Number of facets."""
        return len(self.conn)

    def point_threads(self, worlds: int) -> tuple[int, int, int]:
        """Threads of the points of each facet."""
        return worlds, self.count, self.data.point_count


class FacetTables(Generic[AnyContact]):
    """Contacts and the points of their surfaces in device order, sorted by facet kind.

    Attributes:
        contacts: handles in that order; number: position of a handle's index.
        host: shape functions, areas, slots and positions of each contact, for fields and checks; factors: on their
            stiffness by area. region_areas: m^2, that its stiffness is distributed over.
        kinds: slots and points per facet, and the contact kind.
        own_laws: laws in use that are not built in, as defined when the model was made.
        groups: facet groups.
        points, rows: total numbers of points and facets.
        first, row_start: first point and first facet of each contact.
        area_fractions: (F, P) of each contact: area of each point over that of the region; 0: inactive.
        other_entries, stored_sides: pool entries of the other side, and threads that store it after a step.
    """

    data: Any
    built_values: bytes
    first: np.ndarray
    row_start: np.ndarray
    area_fractions: list[np.ndarray]
    other_entries = 0
    stored_sides = 1

    def __init__(self, model: Model, contacts: Sequence[AnyContact]) -> None:
        self.model = model
        points, factors = zip(*(contact.slave_points() for contact in contacts))
        kinds = [_facet_kind(*pair) for pair in zip(contacts, points)]
        order = sorted(range(len(kinds)), key=lambda k: (kinds[k], k))
        self.kinds = sorted(set(kinds))
        self.contacts: list[AnyContact] = [contacts[k] for k in order]
        self.host: list[ContactPoints] = [points[k] for k in order]
        self.factors = [factors[k] for k in order]
        self.region_areas = [c.region_area(p) for c, p in zip(self.contacts, self.host)]
        self.number = {contact.index: k for k, contact in enumerate(self.contacts)}
        self.own_laws = own_laws(contact.law for contact in contacts)
        self.groups: list[FacetGroup] = []
        self.points = self.rows = 0

    @property
    def connectivity(self) -> list[np.ndarray]:
        """Slots (F, L) of the facets of each group."""
        return [group.conn for group in self.groups]

    @property
    def has_single_point(self) -> bool:
        """True if a contact acts at its deepest point only."""
        return any(contact.model == "sphere" for contact in self.contacts)

    @property
    def tracks_deepest(self) -> bool:
        """True if a contact acts at its deepest position anywhere on its facets."""
        return any(group.data.tracks_deepest for group in self.groups)

    @property
    def rolls(self) -> bool:
        """True if points of round rigid parts roll."""
        return False

    @property
    def explicit(self) -> bool:
        """True if a contact uses the force of the last state."""
        return any(contact.treatment == "explicit" for contact in self.contacts)

    def _build_facets(self, pool: int) -> int:
        """Upload the facets, starting at pool entry `pool`; returns the next free entry."""
        first, row_start = (np.zeros(len(self.contacts) + 1, dtype=np.int64) for _ in range(2))
        for kind in self.kinds:
            chosen = [k for k, pair in enumerate(zip(self.contacts, self.host)) if _facet_kind(*pair) == kind]
            for k in chosen:
                first[k + 1] = first[k] + self.host[k].area.size
                row_start[k + 1] = row_start[k] + len(self.host[k].conn)
            group = self._facet_group(kind, chosen, pool)
            self.groups.append(group)
            pool += group.conn.size
            self.rows += group.count
            self.points += group.count * kind[1]
        self.first, self.row_start = first, row_start
        return pool

    def _facet_group(self, kind: tuple[int, int, int], chosen: list[int], pool: int) -> FacetGroup:
        """Facet group of one kind for the chosen contacts."""
        m = self.model
        parts = [self.host[k] for k in chosen]
        conn = np.concatenate([self.host[k].conn + self.contacts[k].body.slot_offset for k in chosen])
        data = facet_struct(m.dtype)()
        tables = {
            "conn": conn.T,
            "shape": np.moveaxis(np.concatenate([p.shape for p in parts]), 0, 2),
            "X": np.swapaxes(np.concatenate([p.X for p in parts]), 0, 1),
            **self._edge_rows(chosen),
            "area_fraction": np.concatenate([self.area_fractions[k] for k in chosen]).T,
            "area": np.concatenate([p.area for p in parts]).T,
            "contact": np.repeat(chosen, [len(p.conn) for p in parts]),
            "element_depth": np.concatenate([self.contacts[k].own_depths(self.host[k]) for k in chosen]),
            "corners": np.concatenate([corner_points(p) for p in parts]),
        }
        data.first_entry, data.first_row, data.first_point = pool, self.rows, self.points
        _, data.point_count, acts = kind
        data.facet_count, data.tracks_deepest, data.corner_count = (
            len(conn),
            int(acts == MOVING),
            3 if data.point_count in CONTACT_RULES[3] else 4,
        )
        if acts != PATCH:
            points = CONTACT_RULES[data.corner_count][data.point_count].points
            basis, power = lagrange_basis(points)
            tables |= {"point_coords": points, "lagrange_coefficients": basis, "exponents": power}
        m.memory.fill(data, "contact", **tables)
        return FacetGroup(conn, data, acts != PATCH, chosen)

    def _edge_rows(self, chosen: list[int]) -> dict[str, Any]:
        """Fields of the rows of points on edges, of the chosen contacts."""
        return {}

    def law_constants(self, contact: AnyContact, world: int | None = None) -> dict[str, Any]:
        """Constants `MATERIAL_CONSTANTS` of a contact, as built or in one world."""
        area, p = self.region_areas[self.number[contact.index]], self.model.parameters
        return contact_constants(contact, area, partial(p.mass, world=world), p.modulus(world))

    def parameters(self) -> dict[str, Callable[[Any, np.ndarray], None]]:
        """Setters of the parameters of contacts per world, by name, for Model.set_parameter."""
        return {
            f"{c.name}.{name}": partial(self._set_parameter, c, name)
            for c in self.contacts
            for name in WORLD_PARAMETERS
        }

    def _set_parameter(self, contact: AnyContact, name: str, values: Any, mask: np.ndarray) -> None:
        """Write one value of a contact in the chosen worlds."""
        what, k, data = f"contact {contact.name!r}", self.number[contact.index], self.data
        wanted = values_per_world(what, name, values, self.model.worlds)
        mu, mu_static = data.mu.numpy()[:, k], data.mu_static.numpy()[:, k]
        check = partial(check_chosen_values, what, name, wanted, ~mask)
        check(np.isfinite(wanted))
        if name == "mu":
            check(wanted >= 0.0)
            follow = mu_static == mu
            high = np.where(follow, np.inf, mu_static)
            check(wanted <= high, "at most mu_static = {:g}", mu_static)
            set_rows(data.mu_static, (mask, k), np.where(follow, wanted, mu_static)[mask])
        elif name == "mu_static":
            check(wanted >= mu, "at least mu = {:g}", mu)
        elif name == "restitution":
            check((wanted >= LAWS[contact.law].least_restitution) & (wanted <= 1.0))
            wanted = np.where(mask, wanted, 1.0)
            set_rows(data.beta, (mask, k), [restitution_beta(float(e)) for e in wanted[mask]])
            wanted = np.array([speed_damping(contact, float(e)) for e in wanted])
        else:
            check(wanted > 0.0)
        set_rows(getattr(data, WORLD_PARAMETERS[name]), (mask, k), wanted[mask])

    @property
    def parameter_arrays(self) -> dict[str, wp.array]:
        """Arrays written by `Model.set_parameter`."""
        return {name: getattr(self.data, name) for name in (*WORLD_PARAMETERS.values(), "beta")}

    def store_built_values(self) -> None:
        """Store the built values: checkpoints compare them to identify the model."""
        self.built_values = b"".join(array.numpy().tobytes() for array in self.parameter_arrays.values())

    def update_materials(self, mask: np.ndarray) -> None:
        """Recompute the derived constants after material parameters were set in the chosen worlds."""
        m, data = self.model, self.data
        touched = [
            k for k, contact in enumerate(self.contacts) if any(m.parameters.varies(b) for b in bodies_of(contact))
        ]
        if not touched:
            return
        for name in MATERIAL_CONSTANTS:
            if getattr(data, name).shape[0] != m.worlds:
                old = getattr(data, name)
                m.memory.uncount("contact", old)
                setattr(data, name, m.array("contact", np.repeat(old.numpy(), m.worlds, axis=0), old.dtype))
        host = {name: getattr(data, name).numpy() for name in MATERIAL_CONSTANTS}
        for world in np.flatnonzero(mask).tolist():
            for k in touched:
                for name, value in self.law_constants(self.contacts[k], world).items():
                    if name in host:
                        host[name][world, k] = value
        for name, values in host.items():
            getattr(data, name).assign(values)

    def _upload_laws(self, out: Any, law_constants: list[dict[str, Any]]) -> None:
        """Upload the contact law constants; `law_constants` per contact: `MATERIAL_CONSTANTS`."""
        m, C = self.model, self.contacts
        smoothing = [c.smoothing if isinstance(c.smoothing, tuple) else DEFAULT_SMOOTHING for c in C]
        tables = {
            "law": [law_code(c.law, self.own_laws) for c in C],
            "single_point": [int(c.model == "sphere") for c in C],
            "is_explicit": [int(c.treatment == "explicit") for c in C],
            "first_point": self.first,
            "damping_ramp": [float(c.smoothing) if isinstance(c.smoothing, (int, float)) else 0.0 for c in C],
            "force_eps": [pair[0] for pair in smoothing],
            "speed_eps": [pair[1] for pair in smoothing],
            "offset": [c.offset for c in C],
            "overlap_decay_time": [c.overlap_time for c in C],
        }
        tables |= {name: [[row[name] for row in law_constants]] for name in MATERIAL_CONSTANTS}
        per_world = {
            "mu": [c.mu for c in C],
            "mu_static": [c.mu_static for c in C],
            "damping": [speed_damping(c, c.restitution) for c in C],
            "beta": [restitution_beta(c.restitution) for c in C],
            "scale": [c.stiffness for c in C],
        }
        tables |= {name: np.tile(values, (m.worlds, 1)) for name, values in per_world.items()}
        m.memory.fill(out, "contact", **tables)


def bodies_of(contact: Contact | FacetOptions) -> list[Any]:
    """Bodies of a contact."""
    return [surface.body for surface in contact.surfaces]


def _facet_kind(contact: Contact | FacetOptions, p: ContactPoints) -> tuple[int, int, int]:
    """Contact kind of a facet: slots, points, and PATCH, LUMPED or MOVING."""
    lumped = LUMPED if contact.treatment == "explicit" else MOVING
    return p.conn.shape[1], p.area.shape[1], PATCH if contact.model == "patch" else lumped


def check_chosen_values(
    what: str, name: str, values: np.ndarray, left: np.ndarray, good: np.ndarray, text: str = "", limit: Any = None
) -> None:  # fmt: skip
    """Raise ModelError for the first chosen world with an invalid value."""
    for world in np.flatnonzero(~(good | left))[:1]:
        check_values_per_world(
            what, name, values, good | left, text.format(limit[world]) if text else VALID_RANGES[name]
        )
