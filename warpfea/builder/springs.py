"""Methods of ModelBuilder for springs, actuators, foundations and point masses."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp

from ..base.checks import is_number
from ..base.errors import ModelError
from ..kernels.terms.springs import ANGLE, LENGTH, VECTOR
from ..model import assembly
from ..model.description import Description
from ..model.discretisation import PointMass
from ..model.handles import MaterialPoint, NodeSet, SurfaceSet
from ..model.joints import Joint, Vector, VectorPart
from ..model.springs import Bushing, SampledForce, Spring
from .actuators import make_actuator
from .attachments import COINCIDENCE_TOL, make_attachment
from .bodies import unused_name
from .bushings import make_bushing
from .checks import body_of_handle, joint_of

__all__ = ["SpringMethods"]


class SpringMethods:
    """Base of ModelBuilder: `add_spring`, `add_torsion_spring`, `add_actuator`, `add_bushing`, `add_foundation`,
    `add_point_mass`."""

    description: Description

    def add_spring(
        self, first: Any, second: Any, *, stiffness: float | None = None, damping: float = 0.0,
        rest: float | None = None, law: Any = None, name: str | None = None,
    ) -> Spring:  # fmt: skip
        """A spring and damper between two points: force k (length - rest) + c d(length)/dt along their line.

        Args:
            first, second: material points (body.at), nodes or surfaces (their mean), or fixed points (x, y, z) of the
                ground.
            stiffness: k, N/m.
            damping: c, N s/m.
            rest: length without elastic force, m; by default that of the reference. Less is a preload in tension.
            law: in place of stiffness and rest: the force (N, positive in tension) as samples (lengths, forces), with
                a continuous slope and linear beyond the ends, or a wp.func(length: wp.float64, rate: wp.float64) ->
                wp.float64, both smooth in its arguments; `damping` adds to either.
            name: unique name, for set_parameter("NAME.stiffness"), "NAME.damping", "NAME.rest".

        Raises:
            ModelError: points that coincide, a value out of range, or neither or both of stiffness and law.
        """
        name = self._spring_name(name, "spring")
        what = f"spring {name!r}"
        ends = []
        for point, label in ((first, "first"), (second, "second")):
            if hasattr(point, "body"):
                body_of_handle(point, f"{what}: {label}", (MaterialPoint, NodeSet, SurfaceSet), self.description.bodies)
            ends.append(make_attachment(point, f"{what}: {label} point", child=label == "second"))
        P, Q = ends
        if P.body is None and Q.body is None:
            raise ModelError(f"{what}: neither of its points is on a body")
        for end in ends:
            if np.isnan(end.X).any():
                raise ModelError(f"{what}: give a point (x, y, z) of the ground in place of wf.GROUND")
        gap = Q.position(Q.X, what) - P.position(P.X, what)
        length = float(np.linalg.norm(gap.value))
        if length <= COINCIDENCE_TOL * max(P.size, Q.size):
            raise ModelError(f"{what}: its two points coincide, so that its force has no direction")
        if rest is not None and not (is_number(rest) and rest >= 0.0):
            raise ModelError(f"{what}: rest = {rest!r} must be a length, 0 or more")
        values = self._values(what, stiffness=stiffness, damping=damping, rest=rest, law=law, default_rest=length)
        return self._add_spring(Spring(name, LENGTH, [(gap,)], **values, between=f"{P.label} and {Q.label}"))

    def add_torsion_spring(
        self, joint: Joint | str, *, stiffness: float | None = None, damping: float = 0.0, rest: float = 0.0,
        law: Any = None, name: str | None = None,
    ) -> Spring:  # fmt: skip
        """A torsion spring and damper about a revolute joint: moment k (angle - rest) + c d(angle)/dt that turns the
        child back; turns are counted.

        Args:
            joint: as `add_joint` returned it, or its name; its angle is 0 in the reference.
            stiffness, damping: N m, N m s.
            rest: angle without elastic moment, rad.
            law: in place of stiffness and rest, of angle and rate, N m; see `add_spring`.
            name: unique name, as for `add_spring`.

        Raises:
            ModelError: a joint without an angle, or as `add_spring`.
        """
        name = self._spring_name(name, "torsion_spring")
        what = f"spring {name!r}"
        joint = joint_of(joint, what, self.description.joints)
        if joint.angle is None:
            raise ModelError(f"{what}: a {joint.kind} joint has no angle, or its handles do not determine it")
        a, a2, b = joint.angle
        values = self._values(what, stiffness=stiffness, damping=damping, rest=rest, law=law, default_rest=0.0)
        if isinstance(law, wp.Function):
            values["rest"] = 1.0
        return self._add_spring(Spring(name, ANGLE, [(a, b, a2)], **values, between=joint.between))

    def add_actuator(self, joint: Joint | str, torque: Any, *, name: str | None = None) -> Spring:
        """An actuator that turns the child of a revolute joint about its axis, or pushes that of a translational or
        cylindrical joint along it, and the parent the other way. Several on one joint add up.

        Args:
            joint: as `add_joint` returned it, or its name, without drive.
            torque: time law or Control, N m about the axis or N along it; or wf.PD(kp, kd, target=, limit=), implicit
                in the step: its rate is that of the integrator.
            name: unique name; of a PD for set_parameter("NAME.kp"), "NAME.kd", "NAME.limit".

        Raises:
            ModelError: a joint of another kind, or one that is driven.
        """
        name = self._spring_name(name, "actuator")
        joint = joint_of(joint, f"actuator {name!r}", self.description.joints)
        return self._add_spring(make_actuator(name, joint, torque))

    def add_bushing(
        self, first: Any, second: Any, *, stiffness: Any, damping: Any = 0.0, axes: Any = None, name: str | None = None
    ) -> Bushing:
        """A bushing between two places: forces and moments of their relative translation and turn, with a potential
        that is the same from either side.

        It is sum_i k_i (d_i^2 + e_i^2)/4 + sum_i c_i phi_i^2/2: d_i and e_i the relative translation along axis i of
        the first and of the second end, phi_i the angle between their axes i, c_1 = (k_5 + k_6 - k_4)/2 and so on. A
        turn t about axis i alone has the energy k_(3 + i) t^2/2.

        Args:
            first, second: material points (body.at) of solids and rigid parts, or surfaces; wf.GROUND, or a point of
                it. Translations count from the reference.
            stiffness, damping: six values along and about the three axes, N/m, N m/rad, N s/m, N m s/rad; or one. Where
                the damping about an axis is above the sum of the other two, turns about those lose more, by sin^2 t.
            axes: (3, 3) rows, orthonormal, right-handed; by default those of the world. They turn with both ends.
            name: unique name, for set_parameter("NAME.stiffness"), "NAME.damping": six values, or (worlds, 6), of which
                those may be positive that the built ones have springs for.

        Raises:
            ModelError: ends without a rotation, or a value out of range. A turn beyond 170 degrees is refused in a
                step by name.
        """
        name = self._spring_name(name, "bushing")
        what = f"bushing {name!r}"
        known = (MaterialPoint, NodeSet, SurfaceSet)
        for end, label in ((first, "first"), (second, "second")):
            if hasattr(end, "body"):
                body_of_handle(end, f"{what}: {label}", known, self.description.bodies)
        bushing = make_bushing(what, name, first, second, stiffness, damping, axes)
        self.description.bushings.append(bushing)
        self.description.springs += bushing.springs
        return bushing

    def add_foundation(
        self, surface: SurfaceSet, *, stiffness: float, damping: float = 0.0, name: str | None = None
    ) -> Spring:
        """An elastic foundation: a traction -k u - c du/dt per reference area, u the displacement from the reference.

        Args:
            surface: faces of a body.
            stiffness, damping: N/m^3, N s/m^3.
            name: unique name, for set_parameter("NAME.stiffness"), "NAME.damping".

        Raises:
            ModelError: no faces, or a value out of range.
        """
        name = self._spring_name(name, "foundation")
        what = f"foundation {name!r}"
        body = body_of_handle(surface, what, (SurfaceSet,), self.description.bodies)
        values = self._values(what, stiffness=stiffness, damping=damping, rest=0.0, law=None, default_rest=0.0)
        t = assembly.facet_tables(surface)
        area = assembly.facet_areas(body, t)
        items: list[tuple[Vector, ...]] = [
            (Vector(np.zeros(3), (VectorPart(body, t.conn[f], t.shape[min(f, len(t.shape) - 1), q], False),)),)
            for f in range(len(area))
            for q in range(area.shape[1])
        ]
        label = f"surface {surface.name!r} of body {body.name!r}"
        return self._add_spring(Spring(name, VECTOR, items, **values, scale=area.ravel(), between=label))

    def add_point_mass(self, at: Any, mass: float, inertia: float = 0.0) -> None:
        """Add a mass at a point, which counts wherever the mass matrix does: inertia, weight, momentum, energies.

        Args:
            at: a material point, nodes or a surface (their mean, which all of them carry).
            mass: kg, 0 or more.
            inertia: moment of inertia about every axis of the point, kg m^2, that turns with the deformation gradient.

        Raises:
            ModelError: a value out of range, both 0, or an inertia where the rotation is not determined.
        """
        body = body_of_handle(at, "add_point_mass", (MaterialPoint, NodeSet, SurfaceSet), self.description.bodies)
        what = f"point mass on body {body.name!r}"
        for key, value in (("mass", mass), ("inertia", inertia)):
            if not (is_number(value) and value >= 0.0):
                raise ModelError(f"{what}: {key} = {value!r} must be a number, 0 or more")
        if not (mass or inertia):
            raise ModelError(f"{what}: mass and inertia are both 0")
        point = make_attachment(at, what, child=False)
        if inertia and np.abs(point.known_directions - np.eye(3)).max() > 1e-6:
            raise ModelError(
                f"{what}: {point.label} does not determine the rotation of its inertia: give a surface or a point"
            )
        values = (point.slots, point.weights, point.gradients, float(mass), float(inertia))
        body.point_masses.append(PointMass(*values))

    def _spring_name(self, name: str | None, default: str) -> str:
        return unused_name(name, default, {spring.name for spring in self.description.springs}, "spring")

    def _add_spring(self, spring: Spring) -> Spring:
        self.description.springs.append(spring)
        return spring

    @staticmethod
    def _values(
        what: str, *, stiffness: Any, damping: Any, rest: Any, law: Any, default_rest: float
    ) -> dict[str, Any]:  # fmt: skip
        """Checked values of a Spring."""
        if (stiffness is None) == (law is None):
            raise ModelError(f"{what}: give either stiffness or law (a damper alone has stiffness=0)")
        if law is not None and rest not in (None, default_rest):
            raise ModelError(f"{what}: its law gives the force at every length; it has no rest")
        if isinstance(law, (tuple, list)) and len(law) == 2:
            law = SampledForce.from_samples(law[0], law[1], what)
        elif law is not None and not (isinstance(law, wp.Function) and len(law.input_types) == 2):
            raise ModelError(
                f"{what}: law = {law!r} must be (lengths, forces), or a wp.func(length: wp.float64, rate: "
                "wp.float64) -> wp.float64"
            )
        out = {"stiffness": 0.0 if stiffness is None else stiffness, "damping": damping}
        for key, value in out.items():
            if not (is_number(value) and math.isfinite(value) and value >= 0.0):
                raise ModelError(f"{what}: {key} = {value!r} must be a number, 0 or more")
        rest = default_rest if rest is None else rest
        if not (is_number(rest) and math.isfinite(rest)):
            raise ModelError(f"{what}: rest = {rest!r} must be a finite number")
        return {name: float(value) for name, value in (out | {"rest": rest}).items()} | {"law": law}
