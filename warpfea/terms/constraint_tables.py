"""Tables of constraints on the device: rows, their order, and pairs of rows that share slots."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..base.errors import ModelError
from ..base.launch import Launcher
from ..kernels.terms.constraint_blocks import coupling_struct
from ..kernels.terms.constraint_formulas import Formula, formula_kernels
from ..kernels.terms.constraints import (
    DOT,
    FORMULA,
    VELOCITY,
    constraint_kernels,
    constraint_struct,
    joint_struct,
)
from ..kernels.terms.velocity_rows import velocity_kernels
from ..model.assembly import greedy_colouring, grouped_items
from ..model.joints import ConstraintRow, Joint, Vector
from ..time_laws import TimeLaw
from .joint_values import JointAngles
from .time_law_table import TimeLawTable

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["ConstraintTables"]

MAX_DENSE_ROWS = 64
"""Maximum coupled rows of several joints with one inverse matrix; beyond, joints are swept colour by colour."""


class ConstraintTables:
    """Constraint rows of a model on the device, ordered by connected component and by cluster of rows that share slots.

    Attributes:
        joints: in the order of addition; `angles`: those whose turns are counted.
        count: number of rows.
        formulas: of the rows that have one; number k is the row kind FORMULA + k.
        rows_of: row indices of each joint.
        data: device tables.
        component_host, cluster_host: component and cluster of each row; colour_host: colour of each cluster.
        term_host, slot_host, weight_host, on_child_host: weighted slots of the vectors: index 3 row + side of the
            vector, slot, weight, flag of the joint's child; start_host: first of each vector.
        reference_host: constant part of each vector.
        scale_host: factor of each row, which makes c a length, m.
    """

    def __init__(self, model: Model, joints: Sequence[Joint]) -> None:
        self.model = model
        self.joints = list(joints)
        self.angles = JointAngles(model, self.joints)
        self.kernels = constraint_kernels(model.dtype)
        self.data: Any = None
        self.joint_data: Any = None
        self.cluster_sizes = self.colour_sizes = np.zeros(0, dtype=np.int64)
        self.colour_host = self.cluster_host = np.zeros(0, dtype=np.int64)
        self.rows = [row for joint in self.joints for row in joint.rows]
        self.count = len(self.rows)
        formulas = (row.kind for row in self.rows if isinstance(row.kind, Formula))
        self.formulas = list(dict.fromkeys(formulas))
        self.has_velocity_rows = any(row.kind == VELOCITY for row in self.rows)
        names = [formula.name for formula in self.formulas]
        if len({*names}) < len(names):
            raise ModelError(f"two formulas of constraints have one name among {', '.join(names)}: rename one")

    # connectivity, before components are known

    def joint_slots(self) -> list[np.ndarray]:
        """Model slots tied by the rows of each joint."""
        return [
            np.unique(np.concatenate([v.entries()[0] for row in joint.rows for v in row.vectors]))
            for joint in self.joints
        ]

    def mark_constrained(self, free: np.ndarray) -> None:
        """Clear the directions (components, 3) in which a component is tied to the ground."""
        position = self.model.slot_table.kind == 0
        for k, row in enumerate(self.rows):
            felt = False
            for side in range(3):
                slots, weights, _ = self._vector_entries[3 * k + side]
                size = np.abs(weights).sum()
                felt |= bool(abs(weights[position[slots]].sum()) > 1e-9 * size) if len(slots) else False
            if felt:
                axis = row.b.value if row.kind == DOT and not row.b.parts else np.ones(3)
                free[self.component_host[k], np.abs(axis) > 1e-12] = 0.0

    # device tables

    def build(self, component: np.ndarray, laws: TimeLawTable) -> None:
        """Upload the tables; `component` of each slot."""
        self._order_rows(component)
        self._upload_vectors(laws)
        self._upload_row_pairs()
        self._upload_joints()
        self.angles.upload()

    def _order_rows(self, component: np.ndarray) -> None:
        """Sort joints by component and cluster."""
        groups = self.joint_slots()
        free = np.any(self.model.slot_table.free > 0.0, axis=1)
        joint_of = np.concatenate([np.full(len(g), k) for k, g in enumerate(groups)])
        slot = np.concatenate(groups)
        keep = free[slot]
        shared = sp.csr_matrix(
            (np.ones(keep.sum()), (joint_of[keep], slot[keep])), shape=(len(groups), self.model.slots)
        )
        cluster = sp.csgraph.connected_components(shared @ shared.T, directed=False)[1]
        own = np.array([component[g[0]] for g in groups])
        order = np.lexsort((np.arange(len(groups)), cluster, own))
        first, rows, self.rows_of = 0, [], [np.zeros(0, dtype=np.int64)] * len(groups)
        clusters, components = [], []
        for k in order:
            n = len(self.joints[k].rows)
            self.rows_of[k] = np.arange(first, first + n)
            first += n
            rows += self.joints[k].rows
            clusters += [cluster[k]] * n
            components += [own[k]] * n
        self.rows = rows
        # renumber in order of appearance: clusters become ranges of rows
        new_number: dict[int, int] = {}
        self.cluster_host = np.array([new_number.setdefault(int(c), len(new_number)) for c in clusters])
        self.component_host = np.array(components)

    def _upload_vectors(self, laws: TimeLawTable) -> None:
        m, rows = self.model, self.rows
        entries = [vector.entries() for row in rows for vector in row.vectors]
        start = np.concatenate([[0], np.cumsum([len(e[0]) for e in entries])])
        slot = np.concatenate([e[0] for e in entries])
        weight = np.concatenate([e[1] for e in entries])
        self.on_child_host = np.concatenate([e[2] for e in entries])
        term = np.repeat(np.arange(len(entries)), np.diff(start))
        self.term_host, self.slot_host, self.weight_host, self.start_host = term, slot, weight, start
        numbers: dict[TimeLaw, int] = {}
        law = np.full(len(rows), -1)
        for k, row in enumerate(rows):
            if row.law is not None:
                if row.law not in numbers:
                    numbers[row.law] = laws.add(row.law)
                law[k] = numbers[row.law]
        data = constraint_struct()()
        self.scale_host = np.array([r.scale * (m.size if r.angular else 1.0) for r in rows])
        order = np.argsort(slot, kind="stable")
        slot_start = np.concatenate([[0], np.cumsum(np.bincount(slot, minlength=m.slots))])
        self.reference_host = np.array([vector.value for row in rows for vector in row.vectors])
        tables = {
            "kind": [self._kind_number(row) for row in rows],
            "scale": self.scale_host,
            "reference_product": [r.reference_product for r in rows],
            "constant_target": [r.fixed for r in rows],
            "law": law,
            "law_component": [r.component for r in rows],
            "connected_component": self.component_host,
            "term_start": start,
            "term_slot": slot,
            "term_weight": weight,
            "reference": self.reference_host,
            "slot_start": slot_start,
            "slot_term": term[order],
            "slot_weight": weight[order],
        }
        self.model.memory.fill(data, "constraints", **tables)
        self.data = data
        if self.has_velocity_rows:
            zero = np.zeros((3, 3))
            parameters = np.array([zero if r.parameters is None else r.parameters for r in rows])
            self.velocity_parameters = m.array("constraints", parameters, wp.mat33d)
        self._vector_entries = entries

    def _kind_number(self, row: ConstraintRow) -> int:
        return FORMULA + self.formulas.index(row.kind) if isinstance(row.kind, Formula) else row.kind

    def formula_kernels(self, midpoint: bool = False) -> list[tuple[int, Any]]:
        """Row kind and kernels of each formula."""
        return [(k, formula_kernels(self.model.dtype, midpoint, f)) for k, f in enumerate(self.formulas, FORMULA)]

    def update_velocity_rows(self, launch: Launcher, u_stage: wp.array, active: wp.array, multipliers: Any) -> None:
        """A of the rows at the level of velocities, at u_stage."""
        args = [self.data, self.velocity_parameters, u_stage, active, multipliers]
        launch(velocity_kernels(self.model.dtype).update, (self.model.worlds, self.count), args)

    def _upload_row_pairs(self) -> None:
        """Pairs of shared vectors for each pair of rows that share slots: dense within clusters, else couplings."""
        first = self._split_large_clusters()
        shared = self._shared_vectors()
        n = np.diff(first)
        pair_start, pair_side, pair_block = [0], [], []
        couple_start, couple_column = [0], []
        couple_pairs: list[list[tuple[tuple[int, int], int]]] = []
        for i in range(self.count):
            c = self.cluster_host[i]
            columns = shared[i]
            for j in range(first[c], first[c + 1]):
                for side, block in columns.get(j, ()):
                    pair_side.append(side)
                    pair_block.append(block)
                pair_start.append(len(pair_block))
            for j in sorted(columns):
                if self.cluster_host[j] != c:
                    couple_column.append(j)
                    couple_pairs.append(columns[j])
            couple_start.append(len(couple_column))
        couple_pair = [len(pair_block)]
        for pairs in couple_pairs:
            pair_side += [side for side, _ in pairs]
            pair_block += [block for _, block in pairs]
            couple_pair.append(len(pair_block))
        self.coupling_count = len(couple_column)
        self.matrix_entries = int((n**2).sum())
        self.cluster_sizes = n
        couple_row = np.repeat(np.arange(self.count), np.diff(couple_start))
        self._colour_clusters(couple_row, np.array(couple_column, dtype=np.int64))
        tables = {
            "cluster": self.cluster_host,
            "cluster_start": first,
            "matrix_start": np.concatenate([[0], np.cumsum(n**2)[:-1]]),
            "pair_start": pair_start,
            "pair_side": np.reshape(pair_side or [(0, 0)], (-1, 2)),
            "pair_block": pair_block or [0],
            "coupling_start": couple_start,
            "coupling_row": couple_row if len(couple_row) else [0],
            "coupling_column": couple_column or [0],
            "coupling_pair_start": couple_pair,
            "colour": self.colour_host,
            "colour_cluster": np.argsort(self.colour_host, kind="stable"),
        }
        self.model.memory.fill(self.data, "constraints", **tables)

    def _split_large_clusters(self) -> np.ndarray:
        """First row of each cluster, after splitting clusters too large for a dense inverse into joints."""
        sizes = np.bincount(self.cluster_host)
        joint = np.zeros(self.count, dtype=np.int64)
        for k, rows in enumerate(self.rows_of):
            joint[rows] = k
        split = (sizes > MAX_DENSE_ROWS)[self.cluster_host]
        label = np.where(split, self.count + joint, self.cluster_host)
        starts = np.flatnonzero(np.concatenate([[True], label[1:] != label[:-1]]))
        self.cluster_host = np.cumsum(np.concatenate([[0], (label[1:] != label[:-1]).astype(int)]))
        return np.concatenate([starts, [self.count]])

    def _shared_vectors(self) -> list[dict[int, list[tuple[tuple[int, int], int]]]]:
        """Rows that share slots with each row: pairs of sides and the block of both vectors.

        Blocks sum w w' D^-1 over the slots; rows share vectors (the three rows of a pin use one), so blocks are few.
        """
        weights, rows_of_vector, sides = self._vector_weights()
        neighbours, block_start, block_slot, block_weight = _shared_blocks(weights)
        out: list[dict[int, list[tuple[tuple[int, int], int]]]] = []
        for own in sides:
            columns: dict[int, list[tuple[tuple[int, int], int]]] = {}
            for side, u in own:
                for v, block in neighbours[u]:
                    for other, other_side in rows_of_vector[v]:
                        columns.setdefault(other, []).append(((side, other_side), block))
            out.append(columns)
        self.block_count = len(block_start) - 1
        tables = {"block_start": block_start, "block_slot": block_slot or [0], "block_weight": block_weight or [0.0]}
        self.model.memory.fill(self.data, "constraints", **tables)
        return out

    def _vector_weights(
        self,
    ) -> tuple[list[dict[int, float]], list[list[tuple[int, int]]], list[list[tuple[int, int]]]]:
        """Weights of each vector by free slot; its (row, side); and of each row its (side, vector)."""
        free = np.any(self.model.slot_table.free > 0.0, axis=1)
        number: dict[Vector, int] = {}
        weights: list[dict[int, float]] = []
        rows_of_vector: list[list[tuple[int, int]]] = []
        sides: list[list[tuple[int, int]]] = []
        for k, row in enumerate(self.rows):
            own = []
            for side, vector in enumerate((row.a, row.b, row.a2)):
                if vector is None or not vector.parts:
                    continue
                if vector not in number:
                    slots, w, _ = self._vector_entries[3 * k + side]
                    merged: dict[int, float] = {}
                    for s, x in zip(slots.tolist(), w.tolist()):
                        if free[s]:
                            merged[s] = merged.get(s, 0.0) + x
                    number[vector] = len(weights)
                    weights.append(merged)
                    rows_of_vector.append([])
                own.append((side, number[vector]))
                rows_of_vector[own[-1][1]].append((k, side))
            sides.append(own)
        return weights, rows_of_vector, sides

    def _colour_clusters(self, row: np.ndarray, column: np.ndarray) -> None:
        """Greedy colouring of coupled clusters; `colour_sizes` counts the clusters per colour."""
        pairs, n = (self.cluster_host[row], self.cluster_host[column]), len(self.cluster_sizes)
        self.colour_host = greedy_colouring(sp.csr_matrix((np.ones(len(row)), pairs), (n, n)))
        self.colour_sizes = np.bincount(self.colour_host)

    def clusters_above(self, rows: int) -> tuple[wp.array | None, int, int]:
        """Clusters of more than so many rows: their numbers on the device, count, and rows of the largest."""
        large = np.flatnonzero(self.cluster_sizes > rows)
        if not len(large):
            return None, 0, 0
        return self.model.array("constraints", large, wp.int32), len(large), int(self.cluster_sizes[large].max())

    def _upload_joints(self) -> None:
        m = self.model
        position = m.slot_table.kind == 0
        origin = np.concatenate([np.tile(b.origin, (b.slot_count, 1)) for b in m.bodies])
        place = m.slot_table.reference + position[:, None] * origin
        anchors = [joint.anchor.entries() for joint in self.joints]
        data = joint_struct()()
        side = np.where(self.on_child_host, 1, 0)
        for rows in self.rows_of:
            own = slice(self.start_host[3 * rows[0]], self.start_host[3 * rows[-1] + 3])
            if not self.on_child_host[own].any():  # child in space: the parent's reaction
                side[own] = -1
        tables = {
            "first_row": [rows[0] for rows in self.rows_of],
            "end_row": [rows[-1] + 1 for rows in self.rows_of],
            "anchor": [joint.anchor.value for joint in self.joints],
            "anchor_start": np.concatenate([[0], np.cumsum([len(a[0]) for a in anchors])]),
            "anchor_slot": np.concatenate([a[0] for a in anchors] + [np.zeros(1)]),
            "anchor_weight": np.concatenate([a[1] for a in anchors] + [np.zeros(1)]),
            "entry_role": side * (1 + position[self.slot_host]),
            "slot_position": place[self.slot_host],
        }
        self.model.memory.fill(data, "constraints", **tables)
        self.joint_data = data
        for k, joint in enumerate(self.joints):
            joint.index = k

    # host evaluation for supports, tests and users

    def expand_jacobian(self, G: np.ndarray) -> sp.csr_matrix:
        """Rows of the Jacobian, CSR, from the gradients (rows, 3, 3) of their vectors."""
        data = self.weight_host[:, None] * G.reshape(-1, 3)[self.term_host]
        rows = np.repeat(self.term_host // 3, 3)
        columns = (3 * self.slot_host[:, None] + np.arange(3)).ravel()
        return sp.csr_matrix((data.ravel(), (rows, columns)), shape=(self.count, 3 * self.model.slots))

    def formula_derivatives(self, vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First and second derivatives (rows, 3, 3) and (rows, 3, 3, 3, 3), indices side, side, component, component,
        of the rows with formulas at given vectors (rows, 3, 3); of other rows 0."""
        device, n = self.model.device, self.count
        v: Any = wp.array(vectors.reshape(1, 3 * n, 3), dtype=wp.vec3d, device=device)
        gradient = wp.zeros((1, 3 * n), dtype=wp.vec3d, device=device)
        curvature = wp.zeros((1, 9 * n), dtype=wp.mat33d, device=device)
        for kind, k in self.formula_kernels():
            args = [kind, self.data.kind, self.data.scale, v, gradient, curvature]
            Launcher(device)(k.derivatives, (1, n), args)
        return gradient.numpy().reshape(n, 3, 3), curvature.numpy().reshape(n, 3, 3, 3, 3)

    def targets(self, state: Any) -> np.ndarray:
        """Right-hand sides (worlds, rows) of the state, or those at its time if it never stepped."""
        at_time = self.model.terms.constraints.values(state)[2]
        if "constraint_target" not in state.names:
            return at_time
        reached = state.constraint_target.numpy()
        return np.where(np.isnan(reached), at_time, reached)

    def hash(self, h: Any) -> None:
        """Hash the definition of the rows."""
        for row in self.rows:
            h.update(f"{row.kind} {row.scale!r} {row.reference_product!r} {row.fixed!r} {row.component}".encode())
            if row.parameters is not None:
                h.update(row.parameters.tobytes())
        for values in (self.slot_host, self.weight_host, self.start_host, self.reference_host):
            h.update(np.ascontiguousarray(values).tobytes())

    def pattern_couplings(self, pattern: Any) -> tuple[Any, int]:
        """Upper pattern entries that the rows contribute to, their pairs of vectors, and the number of entries."""
        items, term_a, term_b, weight = [], [], [], []
        for row in range(self.count):
            first, last = self.start_host[3 * row], self.start_host[3 * row + 3]
            slot, term, w = self.slot_host[first:last], self.term_host[first:last], self.weight_host[first:last]
            i, j = np.meshgrid(np.arange(len(slot)), np.arange(len(slot)), indexing="ij")
            keep = slot[i] <= slot[j]
            i, j = i[keep], j[keep]
            items.append(pattern.find_upper(slot[i], slot[j]))
            term_a.append(term[i])
            term_b.append(term[j])
            weight.append(w[i] * w[j])
        order, entry, start = grouped_items(np.concatenate(items))
        a, b, w = (np.concatenate(values)[order] for values in (term_a, term_b, weight))
        data = coupling_struct()()
        tables = {"entry": entry, "start": start, "term_a": a, "term_b": b, "weight": w}
        self.model.memory.fill(data, "matrix pattern", **tables)
        return data, len(entry)


def _shared_blocks(
    weights: list[dict[int, float]],
) -> tuple[list[list[tuple[int, int]]], list[int], list[int], list[float]]:
    """For each vector those that it shares slots with and the block of both; start, slots and weights of the blocks."""
    of_slot: dict[int, list[int]] = {}
    for v, merged in enumerate(weights):
        for s in merged:
            of_slot.setdefault(s, []).append(v)
    blocks: dict[tuple[int, int], int] = {}
    neighbours: list[list[tuple[int, int]]] = []
    start, slots, products = [0], [], []
    for u, merged in enumerate(weights):
        own = []
        for v in sorted({v for s in merged for v in of_slot[s]}):
            key = (min(u, v), max(u, v))
            if key not in blocks:
                common = [(s, x * weights[v][s]) for s, x in merged.items() if s in weights[v]]
                blocks[key] = len(start) - 1
                slots += [s for s, _ in common]
                products += [x for _, x in common]
                start.append(len(slots))
            own.append((v, blocks[key]))
        neighbours.append(own)
    return neighbours, start, slots, products
