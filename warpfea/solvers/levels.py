"""Host tables of the two-level preconditioner: tiles, groups with affine functions, Galerkin products, by levels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..kernels.solvers.levels import TILE_SLOTS, level_struct
from ..model.partition import bisect_groups, connected_groups
from .band import Band
from .dense import DenseComponents
from .matrix_assembly import MAX_FULL_FACTOR_SLOTS, Pattern, make_pattern

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["GROUP_SLOTS", "MAX_BOTTOM_SLOTS", "CoarseFunctions", "Level", "make_levels"]

GROUP_SLOTS = 64
"""Maximum slots of a group. Its affine functions are 4 slots of the next level, about 1/16 of the unknowns."""
SMALL_GROUP_SLOTS = (16, 32)
"""Group sizes tried first in a small model, see MAX_SMALL_COARSE_SLOTS."""
MAX_SMALL_COARSE_SLOTS = 48
"""Coarse level size up to which smaller groups are used: a small slender body has too few groups of 64 slots to bend (a
cantilever of 180 slots takes half the iterations)."""
MAX_BOTTOM_SLOTS = {"cpu": 160, "cuda": 1344}
"""Largest coarse level inverted as one dense matrix, slots by device; on CUDA this is cheaper than the launches of
further levels."""
MAX_COUPLED_SLOTS = 448
"""Largest single coarse matrix of bodies that terms couple, slots: a third, as contacts change and it is rebuilt."""
MAX_COMPONENT_PAIRS = 1344**2
"""Maximum slot pairs in components of up to MAX_FULL_FACTOR_SLOTS slots that are each inverted as a whole."""
MAX_LEVELS = 12
"""Bound of the number of levels; each has about a sixteenth of the unknowns of the one above."""


@dataclass(eq=False)
class Level:
    """One level of the preconditioner.

    Attributes:
        pattern: pattern of its matrix.
        slot_count: number of slots.
        is_dense: bottom level, inverted as a whole; no tiles, no groups.
        components: uncoupled components of a dense level.
        band: the only level, factored as a whole; no tiles, no groups.
        device_data: device struct of tiles and groups.
        tile_count, group_count: their numbers; 0 groups: no level below.
        galerkin_tables: device tables of the product that forms the next level's matrix.
    """

    pattern: Pattern
    slot_count: int
    is_dense: bool
    device_data: Any
    tile_count: int = 0
    group_count: int = 0
    galerkin_tables: tuple[wp.array, wp.array, wp.array] | None = None
    band: Band | None = None
    components: DenseComponents | None = None


@dataclass(eq=False)
class ReferencePoints:
    """Reference configuration of a level's slots, at which affine functions are evaluated.

    Attributes:
        reference: (slots, 3) reference value of a slot: a position (m) or a gradient.
        is_position: (slots,) True for a position slot.
        node_index: (slots,) slots of one node share a tile and a group.
        separate_label: (slots,) slots of different labels never share a tile or group.
    """

    reference: np.ndarray
    is_position: np.ndarray
    node_index: np.ndarray
    separate_label: np.ndarray


@dataclass(eq=False)
class CoarseFunctions:
    """Affine functions of the last level's groups, as functions of the slots of the model, for terms that couple them.

    Attributes:
        group_of_slot: [slot] group, of four slots of the last level.
        affine_values: [slot] values of its four functions.
        matrix: dense matrix of the last level, to which terms add.
    """

    group_of_slot: wp.array
    affine_values: wp.array
    matrix: wp.array

    @classmethod
    def of_levels(cls, model: Model, levels: list[Level], matrix: wp.array) -> CoarseFunctions:
        """Those of the last of `levels`."""
        group, value = (getattr(levels[0].device_data, k).numpy() for k in ("group_of_slot", "affine_values"))
        for level in levels[1:-1]:
            slots = 4 * group[:, None] + np.arange(4)
            value = np.einsum("si,sik->sk", value, level.device_data.affine_values.numpy()[slots])
            group = level.device_data.group_of_slot.numpy()[slots[:, 0]]
        vec4 = wp.types.vector(length=4, dtype=model.types.T)
        return cls(model.array("levels", group, wp.int32), model.array("levels", value, vec4), matrix)


def make_levels(
    model: Model, pattern: Pattern, *, coarse: bool = True, by_component: bool = True, coupled: bool = False
) -> list[Level]:
    """Levels of a model, finest first; `pattern` is that of H.

    Without `coarse`, only the tiles of the first level; without `by_component`, dense matrices are not split into
    components; `coupled`: two levels if possible, the second a single dense matrix, in which terms couple the bodies.
    """
    origin = np.concatenate([np.tile(body.origin, (body.slot_count, 1)) for body in model.bodies])
    position = model.slot_table.kind == 0
    place = model.slot_table.reference + origin * position[:, None]
    points = ReferencePoints(place, position, np.cumsum(position) - 1, model.components.mesh_of_slot)
    if not coarse:
        return [_make_level(model, pattern, points, GROUP_SLOTS)[0]]
    found = _coupled_levels(model, pattern, points, by_component) if coupled else []
    if found:
        return found
    levels = []
    bottom = MAX_BOTTOM_SLOTS["cuda" if model.device.is_cuda else "cpu"]
    for depth in range(MAX_LEVELS):
        n = pattern.graph.shape[0]
        components = DenseComponents.from_pattern(model, pattern) if by_component else None
        small = n <= (bottom if depth else MAX_FULL_FACTOR_SLOTS)
        if components and not small:  # one matrix per component
            entries = components.count * components.max_slots**2
            small = entries <= bottom**2 if depth else _inverted_whole(components)
        if small:
            levels.append(Level(pattern, n, True, level_struct(model.dtype)(), components=components))
            return levels
        # larger groups if the next level then becomes the bottom: one dense product costs less than more levels
        large = 2 * GROUP_SLOTS
        capacity = large if 4 * n / GROUP_SLOTS > bottom >= 4.05 * n / large else GROUP_SLOTS
        capacity = next((c for c in SMALL_GROUP_SLOTS if 4.05 * n / c <= MAX_SMALL_COARSE_SLOTS), capacity)
        level, points, pattern = _make_level(model, pattern, points, capacity)
        levels.append(level)
        # below the first level groups may span bodies connected by joints and, where they hardly shrink, any bodies
        if not depth:
            points.separate_label = model.components.of_slot[_representative_slots(level)]
        if level.group_count * 4 > n // 2:
            points.separate_label = np.zeros_like(points.separate_label)
    raise AssertionError("groups do not shrink")


def _inverted_whole(components: DenseComponents) -> bool:
    """True if the components of the first level are each inverted as a whole."""
    entries = components.count * components.max_slots**2
    return components.max_slots <= MAX_FULL_FACTOR_SLOTS and entries <= MAX_COMPONENT_PAIRS


def _coupled_levels(model: Model, pattern: Pattern, points: ReferencePoints, by_component: bool) -> list[Level]:
    """Inverses of small components or tiles, and one dense matrix of the groups; empty if that would be too large."""
    n, bottom = len(points.reference), MAX_COUPLED_SLOTS
    components = DenseComponents.from_pattern(model, pattern) if by_component else None
    whole = components is not None and _inverted_whole(components)
    sizes = (SMALL_GROUP_SLOTS[-1],) if whole else ()
    capacity = next((c for c in (*sizes, GROUP_SLOTS, 2 * GROUP_SLOTS) if 4.05 * n / c <= bottom), 0)
    if not capacity:
        return []
    level, _, below = _make_level(model, pattern, points, capacity)
    if 4 * level.group_count > bottom:
        return []
    if whole:
        level.is_dense, level.components, level.tile_count = True, components, 0
    return [level, Level(below, 4 * level.group_count, True, level_struct(model.dtype)())]


def _representative_slots(level: Level) -> np.ndarray:
    """One representative slot of its group for each slot of the next level."""
    start, slot = level.device_data.group_start.numpy(), level.device_data.group_slot.numpy()
    return np.repeat(slot[start[:-1]], 4)


def _make_level(
    model: Model, pattern: Pattern, points: ReferencePoints, capacity: int
) -> tuple[Level, ReferencePoints, Pattern]:
    n = len(points.reference)
    first = np.flatnonzero(np.diff(points.node_index, prepend=-1))
    sizes = np.diff(first, append=n)
    args = points.reference[first], sizes, points.separate_label[first]
    tile = bisect_groups(*args, TILE_SLOTS)[points.node_index]
    group = connected_groups(bisect_groups(*args, capacity)[points.node_index], pattern.graph)
    tiles, groups = int(tile.max()) + 1, int(group.max()) + 1
    data = level_struct(model.dtype)()
    order = np.argsort(tile, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(tile))])
    place = np.empty(n, dtype=np.int64)
    place[order] = np.arange(n) - start[:-1][tile[order]]
    table = np.full((tiles, TILE_SLOTS), -1)
    table[tile, place] = np.arange(n)
    by_group = np.argsort(group, kind="stable")
    weight, centre, size = _affine_functions(points, group, groups)
    vec4 = wp.types.vector(length=4, dtype=model.types.T)
    tables: dict[str, tuple[Any, Any]] = {
        "tile_slot": (table, wp.int32),
        "tile_of_slot": (tile, wp.int32),
        "position_in_tile": (place, wp.int32),
        "group_start": (np.concatenate([[0], np.cumsum(np.bincount(group))]), wp.int32),
        "group_slot": (by_group, wp.int32),
        "group_of_slot": (group, wp.int32),
        "affine_values": (weight, vec4),
    }
    for name, (values, dtype) in tables.items():
        setattr(data, name, model.array("levels", values, dtype))
    data.tile_count, data.group_count = tiles, groups
    coarse, galerkin = _galerkin_product(model, pattern, group, groups)
    level = Level(pattern, n, False, data, tiles, groups, galerkin)
    value = np.zeros((groups, 4, 3))
    value[:, 0] = centre
    value[:, 1:] = size[:, None, None] * np.eye(3)
    position = np.tile([True, False, False, False], groups)
    node = np.repeat(np.arange(groups), 4)
    label = np.repeat(points.separate_label[by_group[np.flatnonzero(np.diff(group[by_group], prepend=-1))]], 4)
    return level, ReferencePoints(value.reshape(-1, 3), position, node, label), coarse


def _affine_functions(
    points: ReferencePoints, group: np.ndarray, groups: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Values (slots, 4) of the affine functions 1, x, y, z of each slot's group, with the groups' origins and scales.

    x, y, z are relative to the centre (groups, 3), m, divided by the size (groups,), m.
    """
    at = np.flatnonzero(points.is_position)
    count = np.maximum(np.bincount(group[at], minlength=groups), 1)
    centre = np.stack([np.bincount(group[at], points.reference[at, k], groups) / count for k in range(3)], axis=1)
    arm = points.reference - points.is_position[:, None] * centre[group]
    size = np.zeros(groups)
    np.maximum.at(size, group, np.linalg.norm(arm, axis=1))
    size = np.where(size > 0.0, size, 1.0)
    return np.column_stack([points.is_position.astype(float), arm / size[group][:, None]]), centre, size


def _galerkin_product(
    model: Model, pattern: Pattern, group: np.ndarray, groups: int
) -> tuple[Pattern, tuple[wp.array, wp.array, wp.array]]:
    """Pattern of the Galerkin matrix P^T A P, and the tables of `galerkin` in kernels/solvers/blocks.py."""
    graph = pattern.graph
    rows = np.repeat(np.arange(graph.shape[0]), np.diff(graph.indptr))
    key = group[rows].astype(np.int64) * groups + group[graph.indices]
    pairs, count = np.unique(key, return_counts=True)
    order = np.argsort(key, kind="stable")
    first, second = pairs // groups, pairs % groups
    degree = np.bincount(first, minlength=groups)
    start = np.concatenate([[0], np.cumsum(degree)])
    table = np.stack([16 * start[first], 4 * degree[first], 4 * (np.arange(len(pairs)) - start[first])], axis=1)
    entry = np.stack([order, rows[order], graph.indices[order]], axis=1)
    galerkin = (
        model.array("levels", table, wp.vec3i),
        model.array("levels", np.concatenate([[0], np.cumsum(count)]), wp.int32),
        model.array("levels", entry, wp.vec3i),
    )
    coarse = sp.csr_matrix((np.ones(len(pairs), dtype=np.int8), second, start), shape=(groups, groups))
    blocks = sp.kron(coarse, np.ones((4, 4), dtype=np.int8), format="csr")
    blocks.sort_indices()
    return make_pattern(model, blocks, with_upper=False), galerkin
