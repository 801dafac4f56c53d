"""Springs, actuators, stops and friction as data: coordinates of vectors linear in the slots, and their laws."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..base.errors import ModelError
from ..kernels.terms.bounded_laws import FEEDBACK, FRICTION
from ..kernels.terms.springs import ANGLE, LENGTH, TRAVEL
from ..time_laws import TimeLaw
from .joints import Joint, Vector

__all__ = [
    "MAX_FRICTION", "Bushing", "SampledForce", "Spring", "bushing_parts", "coordinate_gradients", "coordinate_value",
    "joint_coordinate",
]  # fmt: skip

MAX_FRICTION = 1e100
"""Largest friction of a joint, N m or N: its energies are finite."""


@dataclass(frozen=True, eq=False)
class SampledForce:
    """Force (N, N m) by samples over a coordinate, joined by cubics whose slopes are continuous; monotone where the
    samples are (Fritsch and Carlson 1980), linear beyond both ends.

    Attributes:
        knots: (pieces,) where each piece begins; the first is that before the samples.
        coefficients: (pieces, 4) of powers of y - knot.
        energy: (pieces,) integral of the force where each piece begins, J: 0 where it is least between the samples.
    """

    knots: np.ndarray
    coefficients: np.ndarray
    energy: np.ndarray

    @classmethod
    def from_samples(cls, y: Any, force: Any, what: str) -> SampledForce:
        """ModelError unless y rises and both have at least two finite samples."""
        try:
            x, f = np.asarray(y, dtype=float), np.asarray(force, dtype=float)
        except (TypeError, ValueError):
            x = f = np.zeros(0)
        if x.ndim != 1 or x.shape != f.shape or len(x) < 2 or not np.isfinite([x, f]).all() or np.diff(x).min() <= 0.0:
            raise ModelError(f"{what}: law must be (lengths, forces) of two samples or more, lengths rising")
        h, secant = np.diff(x), np.diff(f) / np.diff(x)
        m = np.concatenate([secant[:1], np.zeros(len(x) - 2), secant[-1:]])
        before, after = secant[:-1], secant[1:]
        w1, w2 = 2.0 * h[1:] + h[:-1], h[1:] + 2.0 * h[:-1]
        rises = before * after > 0.0
        safe = [np.where(rises, values, 1.0) for values in (before, after)]
        m[1:-1] = np.where(rises, (w1 + w2) / (w1 / safe[0] + w2 / safe[1]), 0.0)
        c2, c3 = (3.0 * secant - 2.0 * m[:-1] - m[1:]) / h, (m[:-1] + m[1:] - 2.0 * secant) / h**2
        zero = np.zeros(1)
        cubic = [np.concatenate([zero, c, zero]) for c in (c2, c3)]
        ends = [np.concatenate([values[:1], values]) for values in (f, m)]
        work = h * (f[:-1] + h * (m[:-1] / 2.0 + h * (c2 / 3.0 + h * c3 / 4.0)))
        energy = np.concatenate([zero, zero, np.cumsum(work)])
        coefficients = np.stack([*ends, *cubic], axis=1)
        least = list(energy)  # it is least at a sample, or where the force vanishes between two
        for q, width, start in zip(coefficients[1:-1], h, energy[1:]):
            t = np.roots(q[::-1])
            t = t.real[(abs(t.imag) < 1e-12) & (t.real > 0.0) & (t.real < width)]
            least += list(start + t * (q[0] + t * (q[1] / 2.0 + t * (q[2] / 3.0 + t * q[3] / 4.0))))
        return cls(np.concatenate([x[:1], x]), coefficients, energy - min(least))


@dataclass(eq=False)
class Spring:
    """Handle of a spring or actuator; stops and friction of joints.

    Attributes:
        name: unique in its model.
        kind: LENGTH, ANGLE, TRAVEL, VECTOR or CHORD of kernels/terms/springs.py.
        items: vectors of each coordinate, all of one spring: one, or many points of a foundation.
        scale: (items,) factor on stiffness and damping: 1, or the area of a point, m^2.
        stiffness, damping, rest, max_force, lower_end, upper_end: of all worlds until `Model.set_parameter`.
        law: in place of a stiffness a SampledForce, a wp.func (y, dy/dt) -> force, or a law of
            kernels/terms/bounded_laws.py.
        schedule: time law of TORQUE and FEEDBACK.
        stick: of FRICTION, max_force over stiffness: the deflection at which it slips.
        between: what it connects.
        keys: its parameters per world, as name and attribute; by default those of a spring.
    """

    name: str
    kind: int
    items: list[tuple[Vector, ...]] = field(repr=False)
    stiffness: float = 0.0
    damping: float = 0.0
    rest: float = 0.0
    scale: np.ndarray = field(default_factory=lambda: np.ones(1), repr=False)
    law: Any = field(default=None, repr=False)
    between: str = ""
    max_force: float = np.inf
    lower_end: float = -np.inf
    upper_end: float = np.inf
    schedule: TimeLaw | None = field(default=None, repr=False)
    stick: float = 0.0
    keys: dict[str, str] | None = field(default=None, repr=False)

    @property
    def parameters(self) -> dict[str, str]:
        """Attributes by the names of its parameters per world."""
        if self.keys is not None:
            return self.keys
        linear = ("stiffness", "rest") if self.law is None else ()
        names = [name for name in (*linear, "damping") if name != "rest" or len(self.scale) == 1]
        return {f"{self.name}.{name}": name for name in names}

    @property
    def bounded(self) -> bool:
        """True with a law of kernels/terms/bounded_laws.py."""
        return isinstance(self.law, int)

    @property
    def scalar(self) -> bool:
        """True with one coordinate of its own: no foundation, no part of a bushing."""
        return self.kind in (LENGTH, TRAVEL, ANGLE) and self.keys != {}

    @property
    def acting(self) -> bool:
        """True for an actuator."""
        return self.bounded and self.law >= FEEDBACK

    @property
    def resists(self) -> bool:
        """True if it resists every motion of its coordinate in statics."""
        return self.stiffness > 0.0 if self.law in (None, FEEDBACK, FRICTION) else not self.bounded


@dataclass(eq=False)
class Bushing:
    """Handle of a bushing: its springs along axes, between directions of its ends, and dampers of the turn.

    Attributes:
        name: unique in its model.
        springs: those of its potential and of its damping.
        parts: number of each in `bushing_parts`.
        place: position of its second end.
    """

    name: str
    springs: list[Spring] = field(repr=False)
    parts: list[int] = field(repr=False)
    place: Vector = field(repr=False)


def bushing_parts(values: np.ndarray, *, damping: bool) -> np.ndarray:
    """Stiffness or damping (..., 15) of the springs of bushings, from the values (..., 6) along and about its axes.

    Along the three axes of both ends, chords between the axes, and, damped alone, products of axis i of the first with
    axis j of the second end.
    """
    along, about = 0.5 * values[..., :3], values[..., 3:]
    by_planes = 0.5 * about.sum(axis=-1, keepdims=True) - about  # of axis i, both others turn about one
    products = np.zeros((*values.shape[:-1], 9))
    if damping:
        i, j = np.divmod(np.arange(9), 3)
        products = np.where(i == j, np.maximum(by_planes, 0.0)[..., i], 0.5 * about[..., (3 - i - j) % 3])
        by_planes = np.zeros_like(about)
    return np.concatenate([along, by_planes, products], axis=-1)


def joint_coordinate(joint: Joint) -> tuple[int, tuple[Vector, ...]] | None:
    """Kind and vectors of the coordinate that actuators of a joint act on: travel, else angle; None without."""
    if joint.travel is not None:
        return TRAVEL, joint.travel
    if joint.angle is not None:
        a, a2, b = joint.angle
        return ANGLE, (a, b, a2)
    return None


def coordinate_value(kind: int, v: np.ndarray) -> float:
    """LENGTH, TRAVEL or ANGLE (within half a turn) of the vectors v (3, 3)."""
    if kind == ANGLE:
        return float(np.arctan2(v[2] @ v[1], v[0] @ v[1]))
    return float(v[0] @ v[1] if kind == TRAVEL else np.linalg.norm(v[0]))


def coordinate_gradients(kind: int, v: np.ndarray) -> list[np.ndarray]:
    """Derivatives (3, 3) of a coordinate, or of the components of a VECTOR, by the vectors v (3, 3), as rows."""
    if kind == TRAVEL:
        return [np.stack([v[1], v[0], np.zeros(3)])]
    if kind != ANGLE:
        n = v[0] / max(np.linalg.norm(v[0]), 1e-300)
        zero = np.zeros(3)
        return [np.stack([e, zero, zero]) for e in ([n] if kind == LENGTH else np.eye(3))]
    a, b, a2 = v
    y, radius = coordinate_value(ANGLE, v), np.hypot(a2 @ b, a @ b)
    return [np.stack([-np.sin(y) * b, np.cos(y) * a2 - np.sin(y) * a, np.cos(y) * b]) / radius]
