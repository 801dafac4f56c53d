"""What an element family is: slots per node, shape functions, rules. Nothing else in the code knows families."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import ModelError
from .quadrature import Rule

__all__ = ["Family", "families", "get", "register"]


@dataclass(frozen=True, eq=False)
class Family:
    """An element family as tables (DESIGN: r = sum e_i s_i, F = sum e_i h_i^T).

    Attributes:
        name: how users select it, e.g. "T10".
        cell_type: mesh cell it is built on, e.g. "tetra10".
        node_slots: slot kinds of each element node; kind 0 is a position, 1..3 a gradient d/dX_k.
        shape: function (xi (Q, d), nodes (E, n, 3)) -> (s (E or 1, Q, S), ds (E or 1, Q, S, 3)), with ds = ds/dxi. A
            family whose functions do not depend on the element's shape returns one row.
        rules: force quadrature rules by name; the first is the default.
        curved_rule: default force rule of curved elements; the patch test on a curved T10 needs degree 3.
        mass_rule: rule that integrates s_i s_j rho det J0 exactly on straight elements.
        curved_mass_rule: the same on curved ones.
        vertices: (V, 3) parent coordinates of the vertices, where J is tested beside the points.
        affine: whether an element with straight sides has one J0.
        node_points: (n, 3) parent coordinates of the element nodes.
    """

    name: str
    cell_type: str
    node_slots: tuple[tuple[int, ...], ...]
    shape: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
    rules: dict[str, Rule]
    curved_rule: Rule
    mass_rule: Rule
    curved_mass_rule: Rule
    vertices: np.ndarray
    affine: bool
    node_points: np.ndarray

    @property
    def slots(self) -> int:
        """Slots per element."""
        return sum(len(kinds) for kinds in self.node_slots)

    @property
    def slot_node(self) -> np.ndarray:
        """(S,) element node of each slot."""
        return np.array([n for n, kinds in enumerate(self.node_slots) for _ in kinds])

    @property
    def slot_kind(self) -> np.ndarray:
        """(S,) kind of each slot."""
        return np.array([k for kinds in self.node_slots for k in kinds])

    def rule(self, name: str | None) -> Rule:
        """Force rule by name (None: the default). Raises ModelError listing the names."""
        if name is None:
            return next(iter(self.rules.values()))
        if name not in self.rules:
            raise ModelError(
                f"quadrature {name!r} is not a rule of element {self.name}; there are {', '.join(self.rules)}"
            )
        return self.rules[name]


_families: dict[str, Family] = {}


def register(family: Family) -> Family:
    """Make a family selectable by name."""
    _families[family.name] = family
    return family


def families() -> Sequence[str]:
    """Names of the registered families."""
    return tuple(_families)


def get(name: str) -> Family:
    """The family `name`. Raises ModelError listing the names, or NotImplementedError for a planned one."""
    if name in _families:
        return _families[name]
    if name in ("ENMC", "FN", "FN18", "H3843", "3243", "3443"):
        raise NotImplementedError(f"element {name!r}: ANCF elements are not part of this version")
    raise ModelError(f"element {name!r} is unknown; there are {', '.join(_families)}")


def for_cell(cell_type: str) -> Family:
    """The first family that is built on a cell type."""
    for family in _families.values():
        if family.cell_type == cell_type:
            return family
    raise ModelError(f"no element family for mesh cells of type {cell_type!r}")
