"""ModelBuilder: scene description with immediate validation."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from ..base.console import quiet_warp
from ..base.errors import ModelError
from ..base.names import check_choice
from ..base.notebook import summary_table
from ..elements.sections import BeamSection, section_along
from ..materials import Material
from ..model.bodies import Body
from ..model.description import BodyForce, Description
from ..model.handles import MaterialPoint, NodeSet, SurfaceSet
from ..model.joints import Joint
from ..model.model import Model
from ..model.rigid import RigidBody
from ..terms.term import Term
from ..terms.term_set import TermSet
from ..time_laws import Rotation
from . import loads
from .actuators import joint_springs
from .attachments import Ground
from .beams import beam_geometry
from .bodies import MeshLike, as_mesh, make_solid, make_structure, shell_geometry, unused_name
from .checks import body_of_handle, check_densities, parse_gravity, warn_implausible
from .contact_methods import ContactMethods
from .joints import make_constraint, make_joint
from .rigid import make_rigid
from .skins import SkinMethods
from .springs import SpringMethods
from .velocity_constraints import VelocityMethods
from .welds import make_weld

__all__ = ["ModelBuilder"]


class ModelBuilder(ContactMethods, SkinMethods, SpringMethods, VelocityMethods):
    """Collects bodies, supports and loads; `finalize` makes a Model.

    Args:
        gravity: (3,) m/s^2, or a time law of it; in statics a law is evaluated at the load factor, 0 to 1.
        up_axis: "Z" or "Y", for outputs.

    Raises:
        ModelError: gravity is not three finite numbers, or the axis is unknown.
    """

    def __init__(self, gravity: Any = (0.0, 0.0, -9.81), up_axis: str = "Z") -> None:
        constant, law = parse_gravity(gravity)
        check_choice("up_axis", up_axis, ("Z", "Y"))
        self.description = Description(gravity=constant, gravity_law=law, up_axis=up_axis)
        self._terms: list[Callable[[Model], Term | None]] = []

    def __repr__(self) -> str:
        return f"ModelBuilder({self.description.summary() or 'no bodies'})"

    def _repr_html_(self) -> str:
        return summary_table("model builder", self.description.table())

    # bodies

    @property
    def bodies(self) -> list[Body]:
        """The bodies added so far."""
        return self.description.bodies

    def add_solid(
        self, mesh: MeshLike, *, material: Material | dict[str, Material], element: str | None = None,
        quadrature: str | None = None, scale: float = 1.0, transform: Any = None, initial: Any = None,
        name: str | None = None,
    ) -> Body:  # fmt: skip
        """Add a solid body.

        Args:
            mesh: file (Gmsh .msh, .vtu, Abaqus .inp), Mesh or meshio.Mesh, m after `scale`.
            material: one law, or laws by element group of the mesh.
            element: "T4" or "T10", by default that of the cells; "ENMC", "FN" or "FN18", the ANCF tetrahedra, on
                tetrahedra (of T10 cells the corner nodes, renumbered; ENMC keeps the curved shape); "H3843",
                the ANCF brick, on hexahedra.
            quadrature: name of the force rule of all elements; T10: "tet4", "tet5_paper", "tet8", "tet14"; T4: "tet1",
                "tet4"; ENMC, FN, FN18: "tet14", "conical4"; H3843: "3x3x3", "4x4x4". By default T10 takes "tet4" where
                straight and "tet8" where curved, T4 "tet1", the others their first.
            scale: factor on the coordinates of the file.
            transform: (4, 4) matrix, or (rotation (3, 3), translation (3,)), applied after `scale`.
            initial: initial positions, a function X (nodes, 3) -> (nodes, 3) or, for T4 and T10, (nodes, 3) in m, if
                different from the stress-free reference.
            name: unique name; by default the mesh's.

        Raises:
            MeshError: unusable file or mesh.
            ModelError: unknown group or rule, elements without material, a name used twice.
        """
        mesh = as_mesh(mesh, "add_solid", scale, transform)
        name = self._body_name(name, mesh.name)
        return self._add_body(make_solid(name, mesh, material, element, quadrature), initial)

    def add_beam(
        self, curve: Any, *, elements: int, section: BeamSection | tuple[BeamSection, BeamSection], normal: Any,
        material: Material, integration: str | None = None, corners: str = "error", initial: Any = None,
        name: str | None = None,
    ) -> Body:  # fmt: skip
        """Add a beam of ANCF 3243 elements; node sets "start" and "end", also as beam.start and beam.end.

        Args:
            curve: points (n, 3), m, of a straight line or polyline; or a smooth function of s in [0, 1] that returns
                (3,), such as wf.spline(points).
            elements: number of elements, of equal length in s.
            section: Rectangle(width, height), whose height lies along the normal; Circle(r), Tube(r, thickness) or
                Section(points, weights); or two of one shape, between which the beam tapers along s.
            normal: (3,), or a function of s; made perpendicular to the axis. A turning normal makes a twisted beam.
            material: one law.
            integration: "tied" (default with SVK; remedies against Poisson, shear and thickness locking, and the
                section's shear and torsion factors), "split" (the Poisson part on the axis alone, as Project Chrono),
                "full" (5x3x3 points, as Paper I; default with the other laws), or "3x2x2" points of the full law; see
                warpfea.elements.ancf_beam.
            corners: "error", or "weld": a rigid corner, where both sides share the deformation gradient (Shabana and
                Mikkola 2003).
            initial: initial positions, a function X (n, 3) -> (n, 3), if different from the stress-free reference.
            name: unique name.

        Raises:
            ModelError: a corner, a normal along the axis, an unknown integration, or an argument out of range.
        """
        name = self._body_name(name, "beam")
        section = section_along(f"body {name!r}", section)
        mesh, axes, frames = beam_geometry(name, curve, elements, section, normal, corners)
        return self._add_body(make_structure(name, mesh, "3243", material, integration, axes, frames, section), initial)

    def add_shell(
        self, mesh: MeshLike, *, thickness: Any, material: Material | dict[str, Material],
        integration: str | None = None, normals: Any = None, corners: str = "error", scale: float = 1.0,
        transform: Any = None, initial: Any = None, name: str | None = None,
    ) -> Body:  # fmt: skip
        """Add a shell of ANCF 3443 elements on the mid-surface of quads.

        Args:
            mesh: file, Mesh or meshio.Mesh of quads, such as wf.mesh.grid; the director of a quad is along
                (X_1 - X_0) x (X_3 - X_0).
            thickness: m; also one per node, (nodes,), or a function X (n, 3) -> (n,).
            material: one law, or laws by element group of the mesh.
            integration: "tied" (default with SVK; remedies against thickness and shear locking, and the shear factor
                5/6), or "full" (4x4x2 points of the full law, as Paper I; default with the other laws); see
                warpfea.elements.ancf_shell.
            normals: directors at the nodes, (nodes, 3) or a function X (n, 3) -> (n, 3), more accurate than the
                quads of a curved surface; by default the mean of the quads' normals.
            corners: "error" if normals differ by more than 30 degrees, or "weld": a rigid corner.
            scale, transform: as for add_solid.
            initial: initial positions, a function X (n, 3) -> (n, 3), if different from the stress-free reference.
            name: unique name; by default the mesh's.

        Raises:
            MeshError: unusable file or mesh.
            ModelError: a mesh that is not of quads, a corner, or an option out of range.
        """
        mesh = as_mesh(mesh, "add_shell", scale, transform)
        name = self._body_name(name, mesh.name)
        axes, frames = shell_geometry(name, mesh, thickness, normals, corners)
        return self._add_body(make_structure(name, mesh, "3443", material, integration, axes, frames), initial)

    def add_rigid(
        self, shape: Any, *, density: float | None = None, mass: float | None = None, inertia: Any = None,
        com: Any = None, material: Material | None = None, name: str | None = None,
    ) -> RigidBody:  # fmt: skip
        """Add a rigid part: twelve coordinates and six constraints, rotations as in Paper I, Eqs. (12)-(14).

        Its handle serves as any body's: joints, welds, loads, moments, supports, drives, probes, contact.

        Args:
            shape: wf.Box, Sphere, Capsule, Cylinder, a closed wf.TriMesh, or a mesh of a volume.
            density, mass: kg/m^3 or kg, one of them.
            inertia: tensor (3, 3) or its diagonal (3,) about the centre of mass in the axes of the scene, kg m^2; by
                default that of a uniform density.
            com: (3,) centre of mass, m, with `inertia`; by default that of a uniform density.
            material: elasticity that a contact takes for the part; by default that of the other side.
            name: unique name.

        Raises:
            ModelError: an open surface without mass, inertia and com, a value that is not positive, or inertias that
                no mass has.
        """
        body = make_rigid(self._body_name(name, "rigid"), shape, density, mass, inertia, com, material)
        self._add_body(body, None)
        self._record_joint(body.rigidity())
        return body

    def _body_name(self, name: str | None, default: str) -> str:
        return unused_name(name, default, {body.name for body in self.bodies}, "body")

    def _add_body(self, body: Body, initial: Any) -> Body:
        body.index = len(self.bodies)
        loads.set_initial_positions(body, initial)
        self.bodies.append(body)
        return body

    # supports

    def clamp(self, nodes: NodeSet, *, slots: str = "all", components: str = "xyz") -> None:
        """Clamp nodes at their initial positions.

        Args:
            nodes: nodes to clamp.
            slots: "all" (built in), or "position" (pinned), "position+axis", or other names joined by "+": "axis" and
                "section" of beams, "surface" and "director" of shells, "gradients" of ANCF solids, or one of them,
                "gradient-x", "gradient-y", "gradient-z". Holding the gradient along the axis at a built-in end adds a
                little stiffness; "position+section" does not. On a plane wall of an ANCF solid hold the positions and
                the gradients along the wall.
            components: letters of "xyz" to clamp, global axes.

        Raises:
            ModelError: an unknown name of slots or components, or nodes of another builder.
        """
        body = self._check_owner(nodes, "clamp", NodeSet)
        self.description.supports.append(loads.clamp_support(body, nodes, slots, components))

    def drive(
        self, nodes: NodeSet, *, displacement: Any = None, rotation: Rotation | None = None, components: str = "xyz",
        slots: str | None = None, name: str | None = None,
    ) -> None:  # fmt: skip
        """Prescribe the motion of nodes.

        Args:
            nodes: nodes to move.
            displacement: time law of the displacement from the reference (3,), m, or (times (n,), values
                (n, nodes, 3)).
            rotation: Rotation about an axis, from the reference.
            components: prescribed letters of "xyz".
            slots: as for clamp; by default "all" with a rotation, which rotates gradients too, and "position" with a
                displacement, which clamps the named gradients.
            name: of the value, for derivatives by it in `wf.Adjoint`.

        Raises:
            ModelError: neither or both of displacement and rotation, or a wrong shape.
        """
        body = self._check_owner(nodes, "drive", NodeSet)
        self.description.supports += loads.drive_supports(body, nodes, displacement, rotation, components, slots, name)

    # loads

    def add_point_load(self, point: MaterialPoint | NodeSet, force: Any, *, name: str | None = None) -> None:
        """A force (time law, N) at a material point (Eq. 72), or shared equally by the nodes of a set.

        `name`: of the load, here and below, for derivatives by it in `wf.Adjoint`.
        """
        body = self._check_owner(point, "add_point_load", MaterialPoint, NodeSet)
        self.description.dead_loads.append(loads.point_load(body, point, force, name))

    def add_moment(self, point: MaterialPoint | NodeSet, moment: Any, *, name: str | None = None) -> None:
        """A moment about fixed directions (time law (3,), N m), at a material point or shared equally by nodes.

        It is work-conjugate to the spin of the section (beams), of the director (shells; the part of the moment
        along the director does nothing), or of the deformation gradient (ANCF solids, and any solid at a point).

        Raises:
            ModelError: nodes without gradient slots (T4, T10).
        """
        body = self._check_owner(point, "add_moment", MaterialPoint, NodeSet)
        self.description.moments.append(loads.moment_load(body, point, moment, name))

    def add_traction(self, surface: SurfaceSet, traction: Any, *, name: str | None = None) -> None:
        """A dead traction (time law (3,), N per m^2 of the reference area) on faces."""
        body = self._check_owner(surface, "add_traction", SurfaceSet)
        self.description.dead_loads.append(loads.dead_traction(body, surface, traction, name))

    def add_pressure(self, surface: SurfaceSet, pressure: Any, *, name: str | None = None) -> None:
        """A follower pressure (time law, Pa) against the current outward normal of faces."""
        body = self._check_owner(surface, "add_pressure", SurfaceSet)
        self.description.pressures.append(loads.follower_pressure(body, surface, pressure, name))

    def add_body_force(self, field: Any, *, bodies: list[Body] | None = None) -> None:
        """A force per mass b(x, t), N/kg, at the current position (Eq. 23).

        Args:
            field: wp.func (x: vec3, t: scalar) -> vec3, in the model's precision or in float32 or float64 as annotated.
            bodies: bodies it acts on; by default all added so far.
        """
        loads.check_field(field)
        chosen = list(self.bodies if bodies is None else bodies)
        for body in chosen:
            self._check_owner(body, "add_body_force", Body)
        self.description.body_forces.append(BodyForce(field, chosen))

    def set_initial(
        self, body: Body, *, velocity: Any = None, angular_velocity: Any = None, displacement: Any = None
    ) -> None:
        """Initial state of a body.

        Args:
            velocity: (3,) m/s, a function X (n, 3) -> (n, 3), or, for T4 and T10, (nodes, 3).
            angular_velocity: (3,) rad/s about the centre of mass.
            displacement: a function X (n, 3) -> (n, 3), m, or, for T4 and T10, (nodes, 3).
        """
        self._check_owner(body, "set_initial", Body)
        loads.set_initial_state(body, velocity, angular_velocity, displacement)

    def add_probe(self, name: str, where: MaterialPoint | SurfaceSet | NodeSet) -> None:
        """Record a point at every step: area mean of a surface, mean of nodes."""
        body = self._check_owner(where, "add_probe", MaterialPoint, SurfaceSet, NodeSet)
        if any(p.name == name for p in self.description.probes):
            raise ModelError(f"probe {name!r} is there already")
        self.description.probes.append(loads.probe_at(name, body, where))

    # joints

    def add_joint(
        self, kind: str, *, parent: Any, child: Any, anchor: Any = None, axis: Any = None, axis2: Any = None,
        drive: Any = None, limits: Any = None, friction: Any = None, stiffness: float | None = None,
        damping: float | None = None, name: str | None = None,
    ) -> Joint:  # fmt: skip
        """Connect two bodies, or a body and the ground, by a joint.

        Args:
            kind: "spherical", "universal", "revolute", "cylindrical", "translational", "fixed", or "distance" (a rod of
                constant length between two points).
            parent, child: wf.GROUND, a material point (body.at), nodes (body.nodes, beam.end), or a surface, by its
                mean position and rotation. On a solid take a surface or several nodes: at one
                point the stress is singular, and the joint softens as the mesh is refined.
            anchor: (3,) m, joint position in the reference; by default that of the child's handle. For a distance
                joint with the ground: the rod's end there.
            axis: (3,) of the hinge or the slide, or the parent's axis of a universal joint.
            axis2: the child's axis of a universal joint, perpendicular to `axis`; by default any such.
            drive: time law: angle (rad) of a revolute joint, child relative to parent, right-handed about the axis,
                any number of turns; travel (m) of a translational joint, the child along the axis; length (m) of
                a distance joint. Angle and travel are 0 in the reference.
            limits: (lower, upper) or a wf.Stop: stops of the angle (turns are counted), or the travel of translational
                and cylindrical joints; one side may be infinite.
            friction: largest torque (N m) or force (N) of Coulomb friction, which sticks by a spring that slips at
                1e-4 rad or m, or a wf.Friction with another stick.
            stiffness, damping: N m/rad and N m s/rad, or N/m and N s/m, of a spring at rest in the reference.
            name: unique name, also for set_parameter("NAME.friction"), "NAME.stiffness", "NAME.lower", ...

        Returns:
            Joint: the handle for add_actuator, sim.joint_value, sim.joint_rate, sim.joint_force, sim.joint_record.

        Raises:
            ModelError: an unknown kind, distant handles without an anchor, coincident points of a rod, a handle that
                does not determine a direction's rotation, or an argument of another kind.
        """
        name = self._joint_name(name, str(kind))
        for side, thing in (("parent", parent), ("child", child)):
            if not isinstance(thing, Ground):
                self._check_owner(thing, f"joint {name!r}: {side}", MaterialPoint, NodeSet, SurfaceSet)
        joint = make_joint(kind, parent, child, anchor, axis, axis2, drive, name)
        for spring in joint_springs(joint, limits, friction, stiffness, damping):
            self._spring_name(spring.name, "")
            self._add_spring(spring)
        return self._record_joint(joint)

    def add_constraint(self, kind: str, *, points: Any, value: Any = None, name: str | None = None) -> Joint:
        """A single basic constraint between points (Paper I, section 5.4).

        Args:
            kind: "DP1", (Q - P).(T - R) = f m^2; "DP2", the same with R on the body of P and Q; "DIST", |P - Q| = f m,
                positive; "PIN", P - Q = f (3,) m; or another of `warpfea.builder.joints.CONSTRAINT_KINDS`.
            points: P, Q (, R, T): material points, nodes or surfaces (their mean), or fixed places (x, y, z), m.
            value: f, a time law; by default 0 of DP1, DP2 and PIN, and the reference distance of DIST.
            name: unique name.

        Raises:
            ModelError: an unknown kind, a wrong number of points, coincident points that define a direction, or
                pinned points apart.
        """
        name = self._joint_name(name, str(kind))
        for k, point in enumerate(points if isinstance(points, (tuple, list)) else ()):
            if hasattr(point, "body"):
                self._check_owner(point, f"constraint {name!r}: point {k + 1}", MaterialPoint, NodeSet, SurfaceSet)
        return self._record_joint(make_constraint(kind, points, value, name))

    def weld(self, first: NodeSet | SurfaceSet, second: SurfaceSet | Body, *, name: str | None = None) -> Joint:
        """Tie a face to another body that contains it, of any element families: beam to solid, shell to solid, ...

        Mortar tie: int phi_i (x - x_second) dA = 0 for each shape function phi_i of the first face, so that only its
        own section deformations are constrained. The first should be the coarser side.

        Args:
            first: a surface; beam.start, beam.end or a named edge of a shell (plate.edge) stand for their faces. Other
                nodes are pinned one by one.
            second: the body, or a surface of it, that contains the first.
            name: unique name.

        Raises:
            ModelError: a point of the first face outside the second body, or one body twice.
        """
        name = self._joint_name(name, "weld")
        self._check_owner(first, f"weld {name!r}", NodeSet, SurfaceSet)
        self._check_owner(second, f"weld {name!r}", SurfaceSet, Body)
        return self._record_joint(make_weld(first, second, name))

    def _joint_name(self, name: str | None, kind: str) -> str:
        return unused_name(name, kind, {joint.name for joint in self.description.joints}, "joint")

    def _record_joint(self, joint: Joint) -> Joint:
        self.description.joints.append(joint)
        return joint

    def finalize(self, *, device: Any = None, dtype: str = "float64", worlds: int = 1, many: bool | None = None
                 ) -> Model:  # fmt: skip
        """Make the constant Model of the description; later additions apply to the next `finalize`.

        Args:
            device: Warp device, e.g. "cpu" or "cuda:0"; by default CUDA if available, else the CPU.
            dtype: "float64" or "float32".
            worlds: number of independent copies of the scene.
            many: "auto" options of solvers take what is fastest for many worlds on a GPU; None: from 64 worlds.

        Raises:
            ModelError: no bodies, unknown device or precision, or gravity or a body force on a body whose material has
                no density.
            CapacityError: the device has too little memory.

        Warns:
            ModelWarning: a size, mass, density or E that suggests a wrong unit (MeshWarning: first three), or a nu
                with volumetric locking.
        """
        check_densities(self.description)
        with quiet_warp():
            model = Model(self.description, self.term_factory(), device=device, dtype=dtype, worlds=worlds, many=many)
        warn_implausible(model)
        return model

    def add_term(self, make: Callable[[Model], Term | None]) -> None:
        """Add a user-defined term to the residual: a function of the Model returning a Term, or None.

        Raises:
            ModelError: `make` is not callable.
        """
        if not callable(make):
            raise ModelError(f"add_term: expected a function or class that takes the Model, got {make!r}")
        self._terms.append(make)

    def term_factory(self) -> Callable[[Model], TermSet]:
        """Factory of a model's terms: those of the package and the added ones."""
        return partial(TermSet, more=tuple(self._terms))

    def _check_owner(self, thing: Any, what: str, *kinds: type) -> Body:
        """Body of a handle, which must be of one of the kinds and of this builder."""
        return body_of_handle(thing, what, kinds, self.bodies)
