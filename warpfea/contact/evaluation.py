"""Contact at a state, independent of a simulation: gaps, elastic forces, positions on both bodies; nodal fields,
pressure and gap; initial overlaps, rejected or stored as offsets."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from scipy.spatial import cKDTree

from ..base.errors import ModelError, ModelWarning
from ..base.launch import Launcher
from ..kernels.contact.carriers import carrier_kernels
from ..kernels.contact.evaluation import collider_evaluation_kernels, pair_evaluation_kernels, pair_results_struct
from ..kernels.contact.facet_structs import facet_side_struct, pair_scratch_struct
from ..kernels.contact.structs import clock_struct, contact_scratch_struct
from ..kernels.contact.thickness import depth_kernel
from ..model.discretisation import Discretisation, element_functions
from ..model.pairs import monomial_exponents
from ..model.state import State
from ..model.surfaces import measure_to_skin
from ..terms.fields import VECTOR
from ..terms.term import FieldSpec
from .collider_tables import ContactTables
from .tables import TOUCHING_DEPTH_RATIO

if TYPE_CHECKING:
    from .facet_tables import PairTables

__all__ = [
    "CONTACT_FIELDS", "contact_field", "evaluate_pairs", "evaluate_points", "nodal_force", "obstacle_contact_points",
    "reference_position_text", "refuse_deep_overlaps", "store_overlaps", "touching_depth",
]  # fmt: skip

CONTACT_FIELDS = {
    "contact_pressure": FieldSpec("contact pressure", "Pa", np.add, np.maximum),
    "gap": FieldSpec("gap", "m", np.fmin, np.fmin),
    "contact_traction": FieldSpec("contact traction", "Pa", np.add, np.add, components=VECTOR),
}
"""Fields of both contact terms: pressures add up, the smallest gap counts."""
AUTO_OVERLAP_RATIOS = np.array([0.05, 0.25])
"""Largest overlap that `overlap` "auto" stores, over the smallest edge of a face and depth of an element behind it."""
ROUNDED_OVERLAP_RATIO = 1e-6
"""Overlap over the model's size up to which "auto" stores it without a warning: that of rounded coordinates."""
MIN_DEEP_OVERLAP_RATIO = 0.1
"""Smallest depth, over the depth limit of the body's thinnest facet, at which an unassigned point counts as inside: the
inside test uses flat triangles."""


@dataclass(frozen=True, eq=False)
class PairEvaluation:
    """All points of the slave surfaces at a state, [world, point].

    Attributes:
        gap: m, 1e30 without a facet nearby. normal: elastic normal force, N. force: on the slave, N, (..., 3).
        facet: of the master surfaces, -1: none. xi: parametric position. reaction: on its slots, N, (..., L, 3).
    """

    tables: PairTables
    gap: np.ndarray
    normal: np.ndarray
    force: np.ndarray
    facet: np.ndarray
    xi: np.ndarray
    reaction: np.ndarray

    def nodal_force(self) -> np.ndarray:
        """Nodal forces of both bodies (worlds, slots, 3), N."""
        t = self.tables
        out = nodal_force(t, self.force)
        for world, point in zip(*np.nonzero(self.force.any(axis=2))):
            slots = t.master_conn[self.facet[world, point]]
            np.add.at(out[world], slots, self.reaction[world, point])
        for group, _ in t.edge_groups:
            data, rows = group.data, np.flatnonzero(group.data.edge_row.numpy() >= 0)
            shape = data.edge_shape.numpy()
            shape = shape.reshape(*shape.shape[:2], 2, len(out), len(rows))[:, :, 0]
            last = data.first_point + group.count * data.point_count
            force = self.force[:, data.first_point : last].reshape(len(out), group.count, -1, 3)[:, rows]
            for world, at_slot in enumerate(np.einsum("plbr,brpk->brlk", shape, force)):
                np.add.at(out[world], group.conn[rows], at_slot)
        return out

    def contact_points(self, body: Any) -> list[BodyContactPoints]:
        """Contact points of a body, as slave or as master."""
        t, out = self.tables, []
        for k, contact in enumerate(t.contacts):
            points = slice(t.first[k], t.first[k + 1])
            gap, normal, area = self.gap[:, points], self.normal[:, points], t.host[k].area.ravel()
            force = self.force[:, points]
            if contact.body is body and not contact.one_sided:
                nearest = np.broadcast_to(nearest_samples(t, k, body), gap.shape)
                out.append(BodyContactPoints(nearest, np.broadcast_to(area, gap.shape), normal, gap, force))
            if contact.facets.body is body:
                X = self._master_positions(points)
                nearest = np.full(gap.shape, -1)
                assigned = self.facet[:, points] >= 0
                nearest[assigned] = nearest_samples(t, k, contact.facets.body, X[assigned])
                # master area: the loaded part only, without the area beside the slave
                out.append(BodyContactPoints(nearest, np.where(normal > 0.0, area, 0.0), normal, gap, -force))
        return out

    def _master_positions(self, points: slice) -> np.ndarray:
        """Reference positions (worlds, points, 3) on master facets, m."""
        t = self.tables
        facet, xi = self.facet[:, points], self.xi[:, points]
        out = np.zeros((*facet.shape, 3))
        first = 0
        for mas in t.masters:
            mine = (facet >= first) & (facet < first + len(mas.conn))
            power = monomial_exponents(mas.corners, mas.degree)
            value = np.prod(xi[mine][:, None, :2] ** power, axis=2)
            out[mine] = np.einsum("pm,pmk->pk", value, mas.reference_position_coefficients[facet[mine] - first])
            first += len(mas.conn)
        return out


class _AtState:
    """Arrays and displacements for an evaluation at a state.

    Attributes:
        u: displacements in float64. all_worlds: [world] flags of 1.
    """

    def __init__(self, term: Any, state: State) -> None:
        self.term, self.state, self.launch = term, state, Launcher(term.model.device)
        self.all_worlds = wp.ones(state.worlds, dtype=wp.int32, device=term.model.device)
        self.u = state.displacement
        if term.double_displacements:
            self.u = self.zeros(self.u.shape, wp.vec3d)
            term.double_displacements.widen(self.launch, state.displacement, self.all_worlds, self.u)

    def zeros(self, shape: tuple[int, ...], dtype: Any) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=self.term.model.device)

    def stored(self, name: str, dtype: Any, shape: tuple[int, ...]) -> wp.array:
        """Array of the state, or zeros."""
        state = self.state
        return getattr(state, name) if name in state.specs else self.zeros((state.worlds, *shape), dtype)

    def fields(self, struct: Any, arrays: dict[str, tuple[tuple[int, ...], Any]]) -> Any:
        """Struct with new arrays of these shapes and types."""
        for name, (shape, dtype) in arrays.items():
            setattr(struct, name, self.zeros(shape, dtype))
        return struct


def evaluate_points(
    term: Any, state: State, history: Any = None, *, places: bool = True
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Gap, m, elastic normal force, N, (worlds, points), and elastic force, N, (..., 3) of contact with colliders.

    Args:
        history: by default that of the state.
        places: assign the gap at the deepest position of a single-point contact to the nearest point.
    """
    m, t, at = term.model, term.tables, _AtState(term, state)
    B, launch = state.worlds, at.launch
    history = history or term.make_history(at.stored)
    other = term.settled_other(at.stored, at.zeros, launch, state)
    attempt = term.make_scratch(B, lambda _, shape, dtype: at.zeros(shape, dtype))
    attempt.approach_speed.fill_(1.0)
    kernels = collider_evaluation_kernels(m.dtype, t.has_meshes, t.seams is not None, t.own_laws)
    clock, before = clock_struct()(), (state.displacement,) * 2
    clock.time, clock.is_static = state.time, 1
    s = {"history": history, "other": other, "attempt": attempt, "clock": clock}
    if term.rolling_kernels:
        term.place_rolling(launch, s, at.u, before, at.all_worlds, settled=1)
    for group in t.groups:
        args = [t.data, other, group.data, history, state.time, state.displacement, attempt]
        launch(kernels.points_at_state, group.point_threads(B), args)
    if term.deepest_kernels:
        s["row_start"] = m.array("contact", t.row_start, wp.int32)
        changed = at.zeros((B,), wp.int32)
        term.choose_deepest(launch, s, state.time, at.u, before, at.all_worlds, changed, fresh=1, settled=1)
    gap, normal = (at.zeros((B, t.points), wp.float64) for _ in range(2))
    force = at.zeros((B, t.points), wp.vec3d)
    for group in t.groups:
        args = [t.data, other, group.data, history, at.u, state.time, attempt, int(places), gap, normal, force]
        launch(kernels.evaluate_at_points, group.point_threads(B), args)
    return gap.numpy(), normal.numpy(), force.numpy()


def evaluate_pairs(term: Any, state: State) -> PairEvaluation:
    """Evaluate all points at a state with its friction spring history."""
    m, t, at = term.model, term.tables, _AtState(term, state)
    B, launch, history = state.worlds, at.launch, term.make_history(at.stored)
    masters = t.master_data(wp.uint64(0))
    boxes = ("box_lower", "box_upper", "refit_lower", "refit_upper")
    arrays: dict[str, tuple[tuple[int, ...], Any]] = dict.fromkeys(boxes, ((B * t.facets,), wp.vec3))
    pair = at.fields(pair_scratch_struct(m.dtype)(), arrays | {"refit_needed": ((1,), wp.int32)})
    at.fields(
        pair.displacement, dict.fromkeys(("value", "director"), ((B, t.facets * masters.max_monomials), wp.vec3d))
    )
    pair.start_displacement = pair.displacement
    dim = (B, t.facets, masters.max_monomials)
    launch(term.search_kernels.update_coefficients, dim, [masters, at.u, at.all_worlds, pair])
    launch(term.search_kernels.check_boxes, (B, t.facets), [masters, at.all_worlds, pair])
    tree = wp.Bvh(pair.refit_lower, pair.refit_upper, groups=t.box_groups)
    if t.edge_groups:
        clock, attempt = clock_struct()(), contact_scratch_struct(m.dtype)()
        clock.time = state.time
        every = B, t.points
        arrays = dict.fromkeys(("facet", "anchor_facet"), (every, wp.int32)) | {"depth": (every, wp.float64)}
        arrays |= dict.fromkeys(("xi", "projection", "normal", "anchor_xi"), (every, wp.vec3d))
        arrays |= {"anchor_gap": (every, wp.vec2d), "deepest_contact": ((B, len(t.bodies)), wp.float64)}
        at.fields(pair, arrays)
        names = ("start_depth", "approach_speed", "activation_gap")
        at.fields(attempt, dict.fromkeys(names, (every, wp.float64)))
    stored = term.make_pair_history(at.stored)
    if t.carriers:
        both, single = (2, B, len(t.carriers)), (B, len(t.carriers))
        at.fields(pair, {"carried_shift": (both, wp.vec3d), "carried_turn": (both, wp.mat33d)})
        at.fields(pair, {"carried_value": (single, wp.vec4d), "carried_angle": (single, wp.float64)})
        value = m.terms.time_laws.values_at_state(launch, state)[0]
        launch(carrier_kernels(m.dtype).carry, single, [masters, value, at.all_worlds, 1, stored, pair])
    other = facet_side_struct(m.dtype)()
    other.masters, other.history, other.scratch = t.master_data(tree.id), stored, pair
    P, L = t.points, t.master_conn.shape[1]
    arrays = dict.fromkeys(("gap", "normal"), ((B, P), wp.float64)) | dict.fromkeys(("force", "xi"), ((B, P), wp.vec3d))
    arrays |= {"facet": ((B, P), wp.int32), "reaction": ((B, P, L), wp.vec3d)}
    found = at.fields(pair_results_struct()(), arrays)
    for group, edges in t.edge_groups:
        args = [t.data, other.masters, edges, group.data, history, other.history, clock, state.displacement]
        launch(term.edge_kernels.begin_edges, (B, edges.edge_count), [*args, at.all_worlds, attempt, pair])
    for group in t.groups:
        args = [t.data, other, group.data, history, state.time, at.u, t.max_gap]
        args += [contact_scratch_struct(m.dtype)(), found]
        launch(pair_evaluation_kernels(m.dtype, t.own_laws).evaluate_pairs, group.point_threads(B), args)
    return PairEvaluation(t, *(getattr(found, field.name).numpy() for field in fields(PairEvaluation)[1:]))


@dataclass(frozen=True, eq=False)
class BodyContactPoints:
    """Contact points of a body, each (worlds, points).

    Attributes:
        nearest: sample of the body nearest to a point, -1: none.
        area: represented area, m^2. normal: elastic normal force, N. gap: m, 1e30 if unknown.
        force: elastic force on the body, with friction, (..., 3), N.
    """

    nearest: np.ndarray
    area: np.ndarray
    normal: np.ndarray
    gap: np.ndarray
    force: np.ndarray


def contact_field(name: str, body: Any, worlds: int, contact_points: list[BodyContactPoints]) -> np.ndarray:
    """Field "contact_pressure" or "gap" (worlds, nodes x samples), or "contact_traction" (..., 3), of a body.

    Every contact point is assigned to the sample closest to it in the reference. Pressure is the elastic normal force
    on a sample's points over their area; several contacts add up. Gap is the minimum over the points, NaN for a sample
    without points.
    """
    nodes = len(body.mesh.points) * body.family.node_samples.shape[1]
    traction = np.zeros((worlds, nodes, 3))
    pressure, least = np.zeros((worlds, nodes)), np.full((worlds, nodes), np.inf)
    for patch in contact_points:
        for world in range(worlds):
            known = patch.nearest[world] >= 0
            at = patch.nearest[world, known]
            area, total = (
                np.bincount(at, weights=x[world, known], minlength=nodes) for x in (patch.area, patch.normal)
            )
            pressure[world] += np.divide(total, area, out=np.zeros(nodes), where=area > 0.0)
            sums = np.zeros((nodes, 3))
            np.add.at(sums, at, patch.force[world, known])
            traction[world] += sums / np.where(area > 0.0, area, np.inf)[:, None]
            np.minimum.at(least[world], at, patch.gap[world, known])
    if name == "contact_traction":
        return traction
    # unassigned points have a gap of 1e30
    return pressure if name == "contact_pressure" else np.where(least < 1e29, least, np.nan)


def obstacle_contact_points(
    t: ContactTables, body: Any, gap: np.ndarray, normal: np.ndarray, force: np.ndarray
) -> list[BodyContactPoints]:  # fmt: skip
    """Contact points of a body with obstacles, from gaps and elastic normal forces of all points."""
    out = []
    for k, contact in enumerate(t.contacts):
        if contact.body is body:
            points = slice(t.first[k], t.first[k + 1])
            nearest, area = nearest_samples(t, k, body), t.host[k].area.ravel()
            shape = gap[:, points].shape
            out.append(BodyContactPoints(np.broadcast_to(nearest, shape), np.broadcast_to(area, shape),
                                         normal[:, points], gap[:, points], force[:, points]))  # fmt: skip
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
        nodes = np.asarray(body.surface_nodes)
        if X is None and not body.rigid:
            p = t.host[k]
            used = np.zeros(body.slot_count, dtype=bool)
            used[p.conn[np.any(np.abs(p.shape) > 1e-12, axis=1)]] = True
            nodes = np.asarray(body.mesh.used_nodes)
            nodes = nodes[used[body.node_slot[nodes]]]
        samples = (nodes[:, None] * count + np.arange(count)).ravel()
        tree = cKDTree(_sample_positions(body)[samples])
        fixed = None if X is not None else samples[tree.query(t.host[k].X.reshape(-1, 3))[1]]
        t.model.cache[key] = (samples, tree, fixed)
    samples, tree, fixed = t.model.cache[key]
    return fixed if X is None else samples[tree.query(X)[1]]


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


def touching_depth(size: float, u: np.ndarray) -> np.ndarray:
    """Largest depth (worlds,), m, treated as touching, at displacements u (worlds, slots, 3)."""
    return np.asarray(TOUCHING_DEPTH_RATIO * size + 4.0 * np.finfo(u.dtype).eps * np.abs(u).max(axis=(1, 2)))


def reference_position_text(tables: ContactTables | PairTables, k: int, point: int) -> str:
    """Reference position of a contact point, as text."""
    X = tables.host[k].X.reshape(-1, 3)[point]
    return "(" + ", ".join(f"{x:.4g}" for x in X) + ")"


def store_overlaps(term: Any, depth: np.ndarray, touching: np.ndarray, overlap: np.ndarray) -> None:
    """Store depths (worlds, points), m, above the touching depth in `overlap` (worlds, points); `term`: of the points.

    Raises:
        ModelError: an overlap with `overlap` "refuse", or with "auto" a deeper one than it stores.

    Warns:
        ModelWarning: overlaps stored by "auto", but for those of rounded coordinates.
    """
    tables, stored = term.tables, []
    for k, contact in enumerate(tables.contacts):
        points = slice(tables.first[k], tables.first[k + 1])
        mine = depth[:, points]
        deep = mine.max(axis=1) > touching
        if not deep.any():
            continue
        limit = {"refuse": 0.0, "offset": np.inf}.get(contact.overlap)
        if limit is None:
            limit = float((AUTO_OVERLAP_RATIOS * term.element_sizes[k]).min())
        world, point = np.unravel_index(int(mine.argmax()), mine.shape)
        of, touched = contact.texts
        where = f"world {world}, reference point {reference_position_text(tables, k, int(point))}"
        text = f"contact {contact.name!r}: {of} begins {mine.max():.3g} m inside {touched} ({where}"
        if mine.max() > limit:
            stores = f"; overlap='auto' stores up to {limit:.3g} m" if contact.overlap == "auto" else ""
            raise ModelError(
                f"{text}{stores}); move one of them, or take overlap='offset', which stores it and lets it decay"
            )
        kept = np.maximum(mine[deep], 0.0)
        overlap[deep, points] = kept.max(axis=1, keepdims=True) if contact.model == "sphere" else kept
        if contact.overlap == "auto" and mine.max() > ROUNDED_OVERLAP_RATIO * term.model.size:
            stored.append(
                f"{text}); it is stored as an offset that decays in overlap_time = {contact.overlap_time:g} s"
            )
    if stored:
        more = f" (and {len(stored) - 1} more contacts)" if len(stored) > 1 else ""
        warnings.warn(
            f"{stored[0]}{more}: move one of them, or write overlap='offset' if that is meant",
            ModelWarning,
            stacklevel=2,
        )


def refuse_deep_overlaps(
    tables: PairTables, u: np.ndarray, places: np.ndarray, facets: np.ndarray, new: np.ndarray
) -> None:
    """Reject bodies that begin deeper in another body than any of its facets reaches.

    Args:
        u: displacements (worlds, slots, 3), m.
        places: positions of the points (worlds, points, 3), m.
        facets: facets that the points are assigned to, -1 for none, (worlds, points).
        new: (worlds,) flags of the worlds that begin.

    Raises:
        ModelError: such a point in a contact without `overlap` "offset".
    """
    for k, contact in enumerate(tables.contacts):
        if contact.overlap == "offset":
            continue
        body, points = contact.facets.body, slice(tables.first[k], tables.first[k + 1])
        limit = tables.masters[tables.master_of[k]].depth_limit
        least = MIN_DEEP_OVERLAP_RATIO * float(limit.min())
        beyond = (0.0 if body.family.solid else float(limit.max())) - least  # margin of the nodal bounding box
        nodes = body.slot_kind == 0
        spans = body.reference[nodes] + body.origin + u[:, body.slot_range][:, nodes]
        low, high = (end(axis=1)[:, None] for end in (spans.min, spans.max))
        x = places[:, points]
        near = ((x > low - beyond) & (x < high + beyond)).all(axis=2) & (facets[:, points] < 0)
        near &= new[:, None] & (tables.host[k].area.ravel() > 0.0)
        seen = set()
        for world in np.flatnonzero(near.any(axis=1)):
            key = (u[world, body.slot_range].tobytes(), x[world, near[world]].tobytes())
            if key in seen:
                continue
            seen.add(key)
            depth = measure_to_skin(body, depth_kernel(), x[world, near[world]], u=u[world, body.slot_range])
            if depth.max() > least:
                point = int(np.flatnonzero(near[world])[depth.argmax()])
                raise ModelError(
                    f"contact {contact.name!r}: {' begins within '.join(contact.texts)} "
                    f"(world {world}, reference point {reference_position_text(tables, k, point)}, "
                    f"{depth.max():.3g} m deep), where no facet of the contact reaches; move one of them, or leave "
                    "these faces out of the contact"
                )
