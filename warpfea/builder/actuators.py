"""Actuators, stops, friction, stiffness and damping of joints: springs of the joint's coordinate."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.linalg

from ..base.checks import is_number
from ..base.errors import ModelError
from ..kernels.terms.bounded_laws import FEEDBACK, FRICTION, STOP, TORQUE
from ..kernels.terms.constraints import DOT
from ..kernels.terms.springs import ANGLE
from ..model.assembly import require_density, rigid_modes
from ..model.joints import Joint, Vector
from ..model.masses import body_mass
from ..model.springs import MAX_FRICTION, Spring, coordinate_gradients, joint_coordinate
from ..time_laws import TimeLaw, time_law

__all__ = ["PD", "Friction", "Stop", "joint_springs", "make_actuator"]

STOP_PERIOD = 1e-2
"""Period of the vibration of a joint's bodies on a stop without a given stiffness, s."""
ACTUATED_KINDS = ("revolute", "translational", "cylindrical")


@dataclass(frozen=True)
class PD:
    """Controller of a joint: torque kp (target - q) - kd dq/dt, implicit in the step.

    Args:
        kp, kd: N m/rad and N m s/rad; of a travel N/m and N s/m.
        target: time law or Control of the angle (rad) or travel (m), 0 in the reference.
        limit: largest torque or force, N m or N; by default none.

    Raises:
        ModelError: a negative or infinite gain, or a limit that is not positive.
    """

    kp: float
    kd: float = 0.0
    target: Any = 0.0
    limit: float | None = None

    def __post_init__(self) -> None:
        for name in ("kp", "kd"):
            _not_negative("wf.PD", name, getattr(self, name))
        if self.limit is not None and not (is_number(self.limit) and self.limit > 0.0):
            raise ModelError(f"wf.PD: limit = {self.limit!r} must be a positive number, or None")


@dataclass(frozen=True)
class Stop:
    """Ends of a joint's angle or travel: beyond them k p + c dp/dt of the penetration p, never pulling.

    Args:
        lower, upper: rad or m, 0 in the reference; -inf or inf for none.
        stiffness: N m/rad or N/m; by default that on which the joint's two bodies, rigid and alone, vibrate with a
            period of 10 ms.
        damping: N m s/rad or N s/m; by default 0 with a given stiffness, else critical.

    Raises:
        ModelError: ends the wrong way round or at one place, or a value out of range.
    """

    lower: float
    upper: float
    stiffness: float | None = None
    damping: float | None = None

    def __post_init__(self) -> None:
        for end in (self.lower, self.upper):
            if isinstance(end, bool) or not isinstance(end, (int, float, np.number)) or math.isnan(end):
                raise ModelError(f"wf.Stop: ends ({self.lower!r}, {self.upper!r}) must be two numbers; inf is no end")
        if not self.lower < self.upper:
            where = "at one place" if self.lower == self.upper else "the wrong way round"
            raise ModelError(f"wf.Stop: ends ({self.lower!r}, {self.upper!r}) are {where}; the lower comes first")
        for name in ("stiffness", "damping"):
            if getattr(self, name) is not None:
                _not_negative("wf.Stop", name, getattr(self, name))
        if self.stiffness == 0.0:
            raise ModelError("wf.Stop: stiffness = 0 stops nothing; leave it out for the default")


@dataclass(frozen=True)
class Friction:
    """Coulomb friction of a joint, whose stick is a spring.

    Args:
        limit: largest torque or force, N m or N.
        stick: deflection at which it slips, rad or m: below the angles or travels of interest.

    Raises:
        ModelError: a negative limit or one beyond any load, or a stick that is not positive.
    """

    limit: float
    stick: float = 1e-4

    def __post_init__(self) -> None:
        _not_negative("wf.Friction", "friction", self.limit)
        if self.limit > MAX_FRICTION:
            raise ModelError(f"wf.Friction: friction = {self.limit!r} is too large; a fixed joint holds at any load")
        if not (is_number(self.stick) and self.stick > 0.0):
            raise ModelError(f"wf.Friction: stick = {self.stick!r} must be a positive number, rad or m")


def _not_negative(what: str, name: str, value: Any) -> None:
    if not (is_number(value) and value >= 0.0):
        raise ModelError(f"{what}: {name} = {value!r} must be a finite number, 0 or more")


def make_actuator(name: str, joint: Joint, torque: Any) -> Spring:
    """Actuator of a joint; see ModelBuilder.add_actuator."""
    what = f"actuator {name!r}"
    kind, vectors = _coordinate(what, joint)
    if isinstance(torque, PD):
        target = time_law(torque.target, f"{what}: target", scalar=True, key=f"{name}.target")
        keys = {f"{name}.kp": "stiffness", f"{name}.kd": "damping"}
        keys |= {} if torque.limit is None else {f"{name}.limit": "max_force"}
        return Spring(
            name, kind, [vectors], float(torque.kp), float(torque.kd), law=FEEDBACK, between=joint.between, keys=keys,
            max_force=math.inf if torque.limit is None else float(torque.limit), schedule=_unramped(target),
        )  # fmt: skip
    law = time_law(torque, f"{what}: torque", scalar=True, key=f"{name}.torque")
    return Spring(name, kind, [vectors], law=TORQUE, between=joint.between, keys={}, schedule=law)


def _unramped(law: TimeLaw) -> TimeLaw:
    """A target is a place: statics must not scale its control with the load."""
    return replace(law, ramped=False) if law.control is not None else law


def joint_springs(joint: Joint, limits: Any, friction: Any, stiffness: Any, damping: Any) -> list[Spring]:
    """Springs of a joint's options; see ModelBuilder.add_joint."""
    what, out = f"joint {joint.name!r}", []
    if limits is not None:
        out.append(_stop_spring(what, joint, limits))
    if friction is not None:
        friction = friction if isinstance(friction, Friction) else Friction(friction)
        limit, stick = float(friction.limit), float(friction.stick)
        kind, vectors = _coordinate(what, joint)
        keys = {f"{joint.name}.friction": "max_force"}
        spring = Spring(f"{joint.name}.friction", kind, [vectors], limit / stick, between=joint.between)
        out.append(replace(spring, law=FRICTION, max_force=limit, stick=stick, keys=keys))
    if stiffness is not None or damping is not None:
        k, c = stiffness or 0.0, damping or 0.0
        keys = {f"{joint.name}.{key}": key for key in ("stiffness", "damping")}
        for key, value in zip(("stiffness", "damping"), (k, c)):
            _not_negative(what, key, value)
        kind, vectors = _coordinate(what, joint)
        spring = Spring(f"{joint.name}.spring", kind, [vectors], float(k), float(c), between=joint.between)
        out.append(replace(spring, keys=keys))
    return out


def _coordinate(what: str, joint: Joint) -> tuple[int, tuple[Vector, ...]]:
    found = joint_coordinate(joint) if joint.kind in ACTUATED_KINDS else None
    if found is None:
        raise ModelError(
            f"{what}: a {joint.kind} joint has no angle or travel to act on, or its handles do not determine it; "
            f"{', '.join(ACTUATED_KINDS)} joints have"
        )
    if any(row.law is not None for row in joint.rows):
        raise ModelError(f"{what}: joint {joint.name!r} is driven: its drive= prescribes what this would act on")
    return found


def _stop_spring(what: str, joint: Joint, limits: Any) -> Spring:
    if not isinstance(limits, Stop):
        if not (isinstance(limits, (tuple, list)) and len(limits) == 2):
            raise ModelError(f"{what}: limits = {limits!r} must be (lower, upper) or a wf.Stop")
        limits = Stop(*limits)
    kind, vectors = _coordinate(what, joint)
    stiffness, damping = limits.stiffness, limits.damping or 0.0
    if stiffness is None:
        if not limits.lower <= 0.0 <= limits.upper:
            raise ModelError(
                f"{what}: limits ({limits.lower:g}, {limits.upper:g}) leave out the reference, 0, so that the stop "
                "starts compressed; if this is meant, give wf.Stop(stiffness=)"
            )
        inertia, rate = _coordinate_inertia(what, joint, kind, vectors), 2.0 * np.pi / STOP_PERIOD
        stiffness = inertia * rate**2
        damping = 2.0 * inertia * rate if limits.damping is None else damping
    name = joint.name
    keys = {f"{name}.lower": "lower_end", f"{name}.upper": "upper_end"}
    keys |= {f"{name}.stop_stiffness": "stiffness", f"{name}.stop_damping": "damping"}
    return Spring(
        f"{name}.stop", kind, [vectors], float(stiffness), float(damping), law=STOP, between=joint.between,
        lower_end=float(limits.lower), upper_end=float(limits.upper), keys=keys,
    )  # fmt: skip


def _coordinate_inertia(what: str, joint: Joint, kind: int, vectors: tuple[Vector, ...]) -> float:
    """Inertia of a joint's coordinate, kg m^2 or kg, of its bodies as if rigid and not held by anything else."""
    bodies = list(dict.fromkeys(p.body for row in joint.rows for v in row.vectors for p in v.parts))
    require_density(bodies, f"the default stiffness of the stops of {what}")
    modes, mass = {}, np.zeros((6 * len(bodies),) * 2)
    for k, body in enumerate(bodies):
        modes[body] = k, rigid_modes(body.reference, body.slot_kind)
        own = slice(6 * k, 6 * k + 6)
        matrix = body_mass(body)
        mass[own, own] = sum(z @ (matrix @ z.T) for z in np.moveaxis(modes[body][1], 2, 0))

    def motion(vector: Vector) -> np.ndarray:
        """(3, modes) change of a vector."""
        out = np.zeros((3, 6 * len(bodies)))
        for part in vector.parts:
            k, z = modes[part.body]
            out[:, 6 * k : 6 * k + 6] += np.einsum("msc,s->cm", z[:, part.slots], part.weights)
        return out

    def change(gradients: Any, of: tuple[Vector, ...]) -> np.ndarray:
        return np.asarray(sum(g @ motion(v) for g, v in zip(gradients, of)))

    assert all(row.kind == DOT for row in joint.rows)
    rows = np.array([change((row.b.value, row.a.value), (row.a, row.b)) for row in joint.rows])
    values = np.array([v.value for v in (*vectors, *vectors)[:3]])
    along = change(coordinate_gradients(kind, values)[0], vectors)
    free = scipy.linalg.null_space(rows)
    compliance = along @ free @ np.linalg.solve(free.T @ mass @ free, free.T @ along)
    if not compliance > 0.0:
        raise ModelError(f"{what}: its {'angle' if kind == ANGLE else 'travel'} can't move; give wf.Stop(stiffness=)")
    return float(1.0 / compliance)
