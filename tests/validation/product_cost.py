"""What one product H p must move and compute, counted from the tables that its kernels take.

Bytes: each launch reads or writes each of its arrays once, as if caches were perfect within a launch and empty between
two. With E elements of S slots and Q points, n slots, C contributions (E S, or the sums of clusters), vectors of
v = 3 w and words of w bytes:

elements, one launch per block
    w(tables) + 4 E (S + 1) + 2 v n + v C (+ v n or 6 w E Q with damping)
        tables: straight tetrahedra 11 w E (J0^-1, det J0, rho det J0) and the parent's tables; others (3 S + 1) w E Q,
        9 w E Q more with axes of the law; shears at T tying points of width W: (2 S + 6 + W) w E T
        by clusters the tables of kernels/elements/cluster.py in place of the 4 E S
sum over the slots, one launch
    4 (n + 1) + 4 C + v C + (2 v + 1) n + 8 n/32 (+ 4 (n + 1) + (4 + w) m for m masses, where elements do not hold it)
matrix of m blocks of 3 x 3, one launch
    4 (n + 1) + (4 + 9 w) m + (2 v + 1) n + 8 (threads)/32

Operations: multiplications and additions each count one, as the kernels write them, before the compiler joins what is
the same; so the count is approximate. Per element:

    points: Q (54 S + law + 136 (straight) + 270 (axes of the law) + 330 (damping)), law 305 (svk) or 285 (orthotropic)
        straight T10 with a point towards each vertex: 96 in place of 54 S, and 480 once, with mass and all else
    shears at points: T (72 S + 4 W + 40);  relative slot values: 12 S
    mass in the elements: 7 S^2 + 12 S

and 3 C + 10 n (+ 6 m of the mass) for the sum, 18 m + 10 n for the matrix.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

if TYPE_CHECKING:
    from warpfea.solvers.residual import Residual

__all__ = ["Cost", "cost"]

LAWS = {"svk": 305, "orthotropic": 285}
STRAIGHT, FRAMED, DAMPED = 136, 270, 330
VERTEX_POINT, VERTEX = 96, 480
COMMON = ("is_position", "material", "coefficients")


@dataclass(frozen=True)
class Cost:
    """Bytes and floating-point operations of a product in one world."""

    bytes: int
    flops: int


def cost(residual: Residual) -> Cost:
    """Count those of `residual.product`, which has been called once. Constraints and follower loads are not counted."""
    model, topo = residual.model, residual.model.topology
    n, vector = model.slots, 3 * wp.types.type_size_in_bytes(model.types.T)
    moved = (2 * vector + 1) * n + 8 * residual.curvature_rows.shape[2]  # p, H p, what is held; p.Hp in parts
    if residual.by_matrix:
        assert residual.assembled is not None
        pattern = residual.assembled.pattern
        moved += _sizes(pattern.data, ("start", "column")) + _size(residual.matrix) // model.worlds
        return Cost(moved, 18 * pattern.entries + 10 * n)
    clusters = residual.clusters
    sums = clusters.sums if clusters else model.contributions
    moved += _sizes(clusters.topology if clusters else topo, ("start", "entry")) + 2 * vector * sums
    flops = 3 * model.contributions + 3 * (sums if clusters else 0) + 10 * n
    if clusters:
        for data, _ in clusters.blocks:
            moved += _sizes(data, ("start", "slot_start", "slot", "table"))
    else:
        moved += _sizes(topo, ("mass_start", "mass_column", "mass_value"))
        flops += 6 * topo.mass_value.size
    for block in model.blocks:
        moved += _block_bytes(block, residual.with_mass, vector, n)
        flops += block.count * _element_flops(block, residual.with_mass)
    return Cost(moved, flops)


def _block_bytes(block: Any, with_mass: bool, vector: int, slots: int) -> int:
    """Tables, u and p of the elements of a block."""
    key = block.key
    names: tuple[str, ...] = COMMON if with_mass else (*COMMON, "conn")
    if key.tying:
        names += ("first", "second", "X_first", "X_second", "coupling")
    else:
        names += ("gradient", "weight")
        names += ("J0_inv", "det_J0") if key.affine else ()
        names += ("mass", "density") if with_mass else ()
        names += ("frame",) if key.framed else ()
    touched = np.zeros(slots, dtype=bool)
    for part in block.parts:
        touched[part.conn + part.body.slot_offset] = True
    fields = 3 if key.damping == "rate" else 2
    past = 2 * vector * block.points * block.count if key.damping == "incremental" else 0
    return _sizes(block.data, names) + fields * vector * int(touched.sum()) + past


def _element_flops(block: Any, with_mass: bool) -> int:
    """Operations of an element."""
    key, S = block.key, block.slots
    if key.tying:
        return 12 * S + block.points * (72 * S + 4 * key.tying.width + 40)
    by_vertices = with_mass and key.vertex
    point = (VERTEX_POINT if by_vertices else 54 * S) + LAWS[key.law]
    point += STRAIGHT if key.affine else 0
    point += FRAMED if key.framed else 0
    point += DAMPED if key.damping in ("incremental", "rate") else 0
    if by_vertices:
        return block.points * point + VERTEX
    return 12 * S + block.points * point + (7 * S * S + 12 * S if with_mass else 0)


def _sizes(struct: Any, names: tuple[str, ...]) -> int:
    return sum(_size(getattr(struct, name)) for name in names)


def _size(array: Any) -> int:
    return int(array.size) * wp.types.type_size_in_bytes(array.dtype)
