"""Joints as data: vectors linear in the slots, and scalar rows made of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..base.errors import ModelError
from ..kernels.terms.constraint_formulas import Formula
from ..kernels.terms.constraints import ANGLE, DISTANCE, DOT, VELOCITY
from ..time_laws import TimeLaw
from .discretisation import Discretisation

__all__ = ["WEIGHT_TOL", "ConstraintRow", "Joint", "Vector", "VectorPart", "check_rows", "constant_vector"]

WEIGHT_TOL = 1e-13
"""Weights below this fraction of a vector's largest are round-off of vanishing functions."""


@dataclass(frozen=True, eq=False)
class VectorPart:
    """One body's part of a vector: sum_i w_i e_i; `on_child_side`: on the joint's child side."""

    body: Discretisation
    slots: np.ndarray
    weights: np.ndarray
    on_child_side: bool


@dataclass(frozen=True, eq=False)
class Vector:
    """A vector in space that is linear in the slots; value (3,) in the reference configuration, m or 1."""

    value: np.ndarray
    parts: tuple[VectorPart, ...] = ()

    def __sub__(self, other: Vector) -> Vector:
        flipped = tuple(VectorPart(p.body, p.slots, -p.weights, p.on_child_side) for p in other.parts)
        return Vector(self.value - other.value, self.parts + flipped)

    def entries(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Model slots, weights and child flags, negligible weights left out. After finalize."""
        if not self.parts:
            return np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0, dtype=bool)
        slots = np.concatenate([p.body.slot_offset + p.slots for p in self.parts])
        weights = np.concatenate([p.weights for p in self.parts])
        child = np.concatenate([np.full(len(p.slots), p.on_child_side) for p in self.parts])
        keep = np.abs(weights) > WEIGHT_TOL * np.abs(weights).max()
        return slots[keep], weights[keep], child[keep]


def constant_vector(value: Any) -> Vector:
    """Constant vector."""
    return Vector(np.asarray(value, dtype=float))


@dataclass(frozen=True, eq=False)
class ConstraintRow:
    """A scalar constraint; see kernels/terms/constraints.py for the kinds.

    Attributes:
        kind: DOT, DISTANCE, ANGLE, a Formula, or VELOCITY.
        a, b, a2: its vectors.
        scale: factor to metres; with `angular` times the model's size.
        law: right side over time, or None: `fixed`.
        component: of the law's value.
        parameters: (3, 3) of a VELOCITY row, see kernels/terms/velocity_rows.py.
    """

    kind: int | Formula
    a: Vector
    b: Vector
    scale: float = 1.0
    a2: Vector | None = None
    law: TimeLaw | None = None
    component: int = 0
    fixed: float = 0.0
    angular: bool = False
    parameters: np.ndarray | None = None

    @property
    def vectors(self) -> tuple[Vector, Vector, Vector]:
        """The three vectors; missing ones are constant."""
        none = constant_vector(np.zeros(3))
        return self.a, self.b, self.a2 or none

    @property
    def reference_product(self) -> float:
        """A.B of the reference, |A|^2 of a distance; exactly 0 for vectors made perpendicular."""
        A, B = self.a.value, self.b.value
        if self.kind == DISTANCE:
            return float(A @ A)
        dot = float(A @ B)
        return 0.0 if abs(dot) < 1e-13 * np.linalg.norm(A) * np.linalg.norm(B) else dot


def check_rows(what: str, rows: Any) -> None:
    """ModelError for anything but a list of constraint rows of known kinds and finite vectors."""
    if not isinstance(rows, (list, tuple)) or not rows or not all(isinstance(row, ConstraintRow) for row in rows):
        raise ModelError(f"{what}: its rows are {rows!r}; expected a list of one ConstraintRow or more, such as [row]")
    for k, row in enumerate(rows):
        if not isinstance(row.kind, Formula) and row.kind not in (DOT, DISTANCE, ANGLE, VELOCITY):
            raise ModelError(f"{what}: row {k} has kind {row.kind!r}; expected DOT, DISTANCE, ANGLE or a Formula")
        for name in ("a", "b", "a2") if row.a2 is not None else ("a", "b"):
            vector = getattr(row, name)
            if not isinstance(vector, Vector):
                raise ModelError(
                    f"{what}: vector {name} of row {k} is {vector!r}; expected a Vector: a difference of points, or "
                    "constant_vector((x, y, z))"
                )
            if vector.value.shape != (3,) or not np.isfinite(vector.value).all():
                raise ModelError(
                    f"{what}: vector {name} of row {k} is {vector.value}; expected three finite numbers: do points "
                    "coincide that give a direction?"
                )


@dataclass(eq=False)
class Joint:
    """Handle of a joint, weld or single constraint.

    Attributes:
        name: unique in its model.
        kind: "revolute", "DP1", "weld", ...
        rows: its scalar constraints.
        anchor: point on the child, reference of the reaction moment.
        angle: vectors (a, a2, b) of the angle atan2(a2.b, a.b), or None.
        travel: vectors (a, b): the joint's travel is a.b, b the parent's axis F n, or None.
        between: connected bodies, for messages.
    """

    name: str
    kind: str
    rows: list[ConstraintRow] = field(repr=False)
    anchor: Vector = field(repr=False)
    between: str = ""
    angle: tuple[Vector, Vector, Vector] | None = field(default=None, repr=False)
    travel: tuple[Vector, Vector] | None = field(default=None, repr=False)
    index: int = -1

    def __repr__(self) -> str:
        return f"Joint({self.name!r}, {self.kind}, {self.between})"
