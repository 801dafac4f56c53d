"""Contact between bodies at a state, independent of a simulation: gaps, elastic forces, positions on both bodies."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.launch import Launcher
from ..kernels.contact.evaluation import pair_evaluation_kernels, pair_results_struct
from ..kernels.contact.facet_structs import pair_scratch_struct
from ..kernels.contact.structs import contact_scratch_struct
from ..model.pairs import monomial_exponents
from ..model.state import State
from .fields import BodyContactPoints, nearest_samples, nodal_force

if TYPE_CHECKING:
    from .facet_tables import PairTables

__all__ = ["PairEvaluation", "evaluate_pairs"]


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
        return out

    def contact_points(self, body: Any) -> list[BodyContactPoints]:
        """Contact points of a body, as slave or as master."""
        t, out = self.tables, []
        for k, contact in enumerate(t.contacts):
            points = slice(t.first[k], t.first[k + 1])
            gap, normal, area = self.gap[:, points], self.normal[:, points], t.host[k].area.ravel()
            if contact.slave.body is body:
                nearest = np.broadcast_to(nearest_samples(t, k, contact.slave.body), gap.shape)
                out.append(BodyContactPoints(nearest, np.broadcast_to(area, gap.shape), normal, gap))
            if contact.master.body is body:
                X = self._master_positions(points)
                nearest = np.full(gap.shape, -1)
                seated = self.facet[:, points] >= 0
                nearest[seated] = nearest_samples(t, k, contact.master.body, X[seated])
                # master area: the loaded part only, without the area beside the slave
                out.append(BodyContactPoints(nearest, np.where(normal > 0.0, area, 0.0), normal, gap))
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


def evaluate_pairs(term: Any, state: State) -> PairEvaluation:
    """Evaluate all points at a state with its friction spring history."""
    m, t, B = term.model, term.tables, state.worlds
    launch = Launcher(m.device)

    def zeros(shape: tuple[int, ...], dtype: Any) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=m.device)

    def state_or_zeros(name: str, dtype: Any, shape: tuple[int, ...]) -> wp.array:
        return getattr(state, name) if name in state.specs else zeros((B, *shape), dtype)

    history, pair_history = term.make_history(state_or_zeros), term.make_pair_history(state_or_zeros)
    all_worlds = wp.ones(B, dtype=wp.int32, device=m.device)
    u = state.displacement
    if term.double_displacements:
        u = zeros(u.shape, wp.vec3d)
        term.double_displacements.widen(launch, state.displacement, all_worlds, u)

    def allocate_fields(struct: Any, arrays: dict[str, tuple[tuple[int, ...], Any]]) -> Any:
        for name, (shape, dtype) in arrays.items():
            setattr(struct, name, zeros(shape, dtype))
        return struct

    masters = t.master_data(wp.uint64(0))
    arrays: dict[str, tuple[tuple[int, ...], Any]] = dict.fromkeys(
        ("u_coefs", "director_u_coefs"), ((B, t.facets * masters.max_monomials), wp.vec3d)
    )
    arrays |= dict.fromkeys(("box_lower", "box_upper", "refit_lower", "refit_upper"), ((B * t.facets,), wp.vec3))
    pair = allocate_fields(pair_scratch_struct(m.dtype)(), arrays | {"refit_needed": ((1,), wp.int32)})
    pair.start_u_coefs = pair.u_coefs
    launch(
        term.search_kernels.update_coefficients,
        (B, t.facets, masters.max_monomials),
        [masters, u, all_worlds, pair.u_coefs, pair.director_u_coefs],
    )
    launch(term.search_kernels.check_boxes, (B, t.facets), [masters, all_worlds, pair])
    tree = wp.Bvh(pair.refit_lower, pair.refit_upper, groups=t.box_groups)
    P, L = t.points, t.master_conn.shape[1]
    arrays = dict.fromkeys(("gap", "normal"), ((B, P), wp.float64)) | dict.fromkeys(("force", "xi"), ((B, P), wp.vec3d))
    found = allocate_fields(
        pair_results_struct()(), arrays | {"facet": ((B, P), wp.int32), "reaction": ((B, P, L), wp.vec3d)}
    )
    for group in t.groups:
        args = [t.data, t.master_data(tree.id), group.data, history, pair_history, state.time, u, t.max_gap]
        args += [contact_scratch_struct(m.dtype)(), pair, found]
        launch(pair_evaluation_kernels(m.dtype).evaluate_pairs, (B, group.count, group.data.point_count), args)
    return PairEvaluation(t, *(getattr(found, field.name).numpy() for field in fields(PairEvaluation)[1:]))
