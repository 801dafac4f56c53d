"""ModelBuilder: what a user says of a scene, checked as it is said."""

from __future__ import annotations

import itertools
import pathlib
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from .. import elements as element_families
from .. import mesh as meshes
from ..base.errors import ModelError
from ..elements.sections import Rectangle
from ..laws import time_law
from ..materials import Material
from ..mesh import Mesh
from ..model.assembly import center_of_mass, surface_weights
from ..model.bodies import Body
from ..model.description import (
    BodyForce,
    DeadLoad,
    Description,
    Moment,
    Pressure,
    Probe,
    Rotation,
    Support,
    support_slots,
)
from ..model.handles import ElementSet, MaterialPoint, NodeSet, SurfaceSet
from ..model.joints import Joint
from .beams import beam_geometry
from .checks import assign_materials, component_mask, slot_field, vector
from .joints import Ground, make_constraint, make_joint
from .shells import shell_geometry
from .solids import solid_geometry
from .welds import make_weld

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["ModelBuilder"]

HANDLES: dict[type, str] = {
    Body: "the body",
    NodeSet: "nodes (body.nodes)",
    SurfaceSet: "a surface (body.surface)",
    ElementSet: "elements (body.elements)",
    MaterialPoint: "a point (body.at)",
}


class ModelBuilder:
    """Collects bodies, supports and loads; `finalize` makes a Model of them.

    Args:
        gravity: (3,) m/s^2.
        up_axis: "Z" or "Y", for outputs.

    Raises:
        ModelError: gravity is not three finite numbers, or the axis is unknown.
    """

    def __init__(self, gravity: Any = (0.0, 0.0, -9.81), up_axis: str = "Z") -> None:
        self.gravity = vector(gravity, "gravity")
        if up_axis not in ("Z", "Y"):
            raise ModelError(f"up_axis = {up_axis!r} is neither 'Z' nor 'Y'")
        self.up_axis = up_axis
        self.description = Description()

    # bodies

    @property
    def bodies(self) -> list[Body]:
        """The bodies added so far."""
        return self.description.bodies

    def add_solid(
        self,
        mesh: str | pathlib.Path | Mesh,
        *,
        material: Material | dict[str, Material],
        element: str | None = None,
        quadrature: str | None = None,
        scale: float = 1.0,
        transform: Any = None,
        initial: Any = None,
        name: str | None = None,
    ) -> Body:
        """Add a solid body.

        Args:
            mesh: file (Gmsh .msh, .vtu, Abaqus .inp) or Mesh, m after `scale`.
            material: one law, or laws by element group of the mesh.
            element: "T4" or "T10", by default as the cells are; "ENMC", "FN" or "FN18", the ANCF tetrahedra, on
                tetrahedra (of T10 cells the corner nodes stay, numbered anew; ENMC keeps the curved shape); "H3843",
                the ANCF brick, on hexahedra.
            quadrature: name of the force rule of all elements; T10: "tet4", "tet5_paper", "tet8", "tet14"; T4: "tet1",
                "tet4"; ENMC, FN, FN18: "tet14", "conical4"; H3843: "3x3x3", "4x4x4". By default T10 takes "tet4" where
                straight and "tet8" where curved, T4 "tet1", the others their first.
            scale: factor on the coordinates of the file.
            transform: (4, 4) matrix, or (rotation (3, 3), translation (3,)), applied after `scale`.
            initial: initial positions, a function X (nodes, 3) -> (nodes, 3) or, for T4 and T10, (nodes, 3) in m, where
                they differ from the stress-free reference.
            name: unique name; by default the mesh's.

        Raises:
            MeshError: the file or mesh can't be used.
            ModelError: unknown group or rule, elements without material, a name used twice.
        """
        mesh = self._mesh(mesh, "add_solid", scale, transform)
        name = self._name(name or mesh.name, given=name is not None)
        if len(mesh.cells) == 0:
            raise ModelError(f"body {name!r}: the mesh has no elements")
        if element is None and mesh.cell_type in ("quad", "line"):
            raise ModelError(
                f"body {name!r}: {mesh.label} is a surface of {mesh.cell_type} cells, not a solid; use add_shell(mesh, "
                "thickness=...)"
            )
        family = element_families.get(element) if element else element_families.for_cell(mesh.cell_type)
        mesh, frames = solid_geometry(name, mesh, family)
        rule = family.rule(quadrature).name
        curved = family.curved_rule.name if quadrature is None else rule
        return self._add(
            Body(name, mesh, family, *assign_materials(name, mesh, material), rule, curved, frames), initial
        )

    def add_beam(
        self,
        curve: Any,
        *,
        elements: int,
        section: Rectangle,
        normal: Any,
        material: Material,
        integration: str | None = None,
        corners: str = "error",
        initial: Any = None,
        name: str | None = None,
    ) -> Body:
        """Add a beam of ANCF 3243 elements; node sets "start" and "end", also as beam.start and beam.end.

        Args:
            curve: points (n, 3), m, of a straight line or polyline; or a smooth function of s in [0, 1] that returns
                (3,), such as wf.spline(points).
            elements: number of elements, of equal length in s.
            section: Rectangle(width, height); the height lies along the normal.
            normal: (3,), or a function of s; made perpendicular to the axis. A turning normal makes a twisted beam.
            material: one law.
            integration: "tied" (default with SVK; remedies against Poisson, shear and thickness locking, and the
                section's shear and torsion factors), "split" (the Poisson part on the axis alone, as Project Chrono),
                "full" (5x3x3 points, as Paper I; default with the other laws), or "3x2x2" points of the full law; see
                warpfea.elements.ancf_beam.
            corners: "error", or "weld": a rigid corner, where both sides share the deformation gradient (Shabana and
                Mikkola 2003).
            initial: initial positions, a function X (n, 3) -> (n, 3), where they differ from the stress-free reference.
            name: unique name.

        Raises:
            ModelError: a corner, a normal along the axis, an unknown integration, or an argument out of range.
        """
        name = self._name(name or "beam", given=name is not None)
        mesh, axes, frames = beam_geometry(name, curve, elements, section, normal, corners)
        return self._add_structure(name, mesh, "3243", material, integration, axes, frames, initial, section)

    def add_shell(
        self,
        mesh: str | pathlib.Path | Mesh,
        *,
        thickness: float,
        material: Material | dict[str, Material],
        integration: str | None = None,
        normals: Any = None,
        corners: str = "error",
        scale: float = 1.0,
        transform: Any = None,
        initial: Any = None,
        name: str | None = None,
    ) -> Body:
        """Add a shell of ANCF 3443 elements on the mid-surface of quads.

        Args:
            mesh: file or Mesh of quads, such as wf.mesh.grid; the director points where the quads turn left-handed
                about it, (X_1 - X_0) x (X_3 - X_0).
            thickness: m.
            material: one law, or laws by element group of the mesh.
            integration: "tied" (default with SVK; remedies against thickness and shear locking, and the shear factor
                5/6), or "full" (4x4x2 points of the full law, as Paper I; default with the other laws); see
                warpfea.elements.ancf_shell.
            normals: directors at the nodes, (nodes, 3) or a function X (n, 3) -> (n, 3), of a curved surface known
                better than by its quads; by default the mean of the quads' normals.
            corners: "error" where normals differ by more than 30 degrees, or "weld": a rigid corner.
            scale, transform: as for add_solid.
            initial: initial positions, a function X (n, 3) -> (n, 3), where they differ from the stress-free reference.
            name: unique name; by default the mesh's.

        Raises:
            MeshError: the file or mesh can't be used.
            ModelError: a mesh that is not of quads, a corner, or an option out of range.
        """
        mesh = self._mesh(mesh, "add_shell", scale, transform)
        name = self._name(name or mesh.name, given=name is not None)
        axes, frames = shell_geometry(name, mesh, thickness, normals, corners)
        return self._add_structure(name, mesh, "3443", material, integration, axes, frames, initial)

    def _add_structure(
        self,
        name: str,
        mesh: Mesh,
        element: str,
        material: Any,
        integration: str | None,
        axes: np.ndarray,
        frames: np.ndarray,
        initial: Any,
        section: Rectangle | None = None,
    ) -> Body:
        materials, index = assign_materials(name, mesh, material)
        family = element_families.get(element)
        split = all(law.law == "svk" for _, law in materials)
        scheme = integration or ("tied" if split else "full")
        known = [*family.schemes, *family.rules]
        if scheme not in known:
            raise ModelError(f"body {name!r}: integration = {scheme!r} is none of {', '.join(map(repr, known))}")
        if scheme in family.schemes and not split:
            bad = next(law for _, law in materials if law.law != "svk")
            raise ModelError(
                f"body {name!r}: integration = {scheme!r} splits the St. Venant-Kirchhoff law; use 'full' with "
                f"{type(bad).__name__}"
            )
        return self._add(Body(name, mesh, family, materials, index, scheme, scheme, frames, axes, section), initial)

    def _mesh(self, mesh: Any, what: str, scale: float, transform: Any) -> Mesh:
        if isinstance(mesh, (str, pathlib.Path)):
            mesh = meshes.read(mesh, scale=scale, transform=transform)
        elif not isinstance(mesh, Mesh):
            raise ModelError(f"{what}: mesh must be a file name or a Mesh, got {type(mesh).__name__}")
        else:
            if scale != 1.0 or transform is not None:
                mesh = mesh.transformed(scale=scale, transform=transform)
            meshes.check(mesh)
        return mesh

    def _add(self, body: Body, initial: Any) -> Body:
        body.index = len(self.bodies)
        if initial is not None:
            body.initial_displacement = slot_field(body, initial, f"body {body.name!r}: initial") - slot_field(
                body, lambda X: X, ""
            )
        self.bodies.append(body)
        return body

    # supports

    def clamp(self, nodes: NodeSet, *, slots: str = "all", components: str = "xyz") -> None:
        """Hold nodes at their initial place.

        Args:
            nodes: what to hold.
            slots: "all" (built in), or "position" (pinned), "position+axis", or other names joined by "+": "axis" and
                "section" of beams, "surface" and "director" of shells, "gradients" of ANCF solids, or one of them,
                "gradient-x", "gradient-y", "gradient-z". Holding the gradient along the axis at a built-in end adds a
                little stiffness; "position+section" does not. On a plane wall of an ANCF solid hold the positions and
                the gradients along the wall.
            components: which of "xyz" to hold, global axes.

        Raises:
            ModelError: an unknown name of slots or components, or nodes of another builder.
        """
        body = self._own(nodes, "clamp", NodeSet)
        held = support_slots(nodes, slots)
        if not len(held):
            raise ModelError(f"clamp on {body.name!r}: the nodes {nodes.name!r} have no slots {slots!r}")
        mask = component_mask(components, f"clamp on {body.name!r}")
        self.description.supports.append(Support(body, held, mask))

    def drive(
        self,
        nodes: NodeSet,
        *,
        displacement: Any = None,
        rotation: Rotation | None = None,
        components: str = "xyz",
        slots: str | None = None,
    ) -> None:
        """Move nodes on a prescribed path.

        Args:
            nodes: what to move.
            displacement: time law of the displacement from the reference (3,), m, or (times (n,), values
                (n, nodes, 3)).
            rotation: Rotation about an axis, from the reference.
            components: which of "xyz" are prescribed.
            slots: as for clamp; by default "all" with a rotation, which turns gradients too, and "position" with a
                displacement, which holds gradients that are named.

        Raises:
            ModelError: neither or both of displacement and rotation, or a wrong shape.
        """
        body = self._own(nodes, "drive", NodeSet)
        what = f"drive of {nodes.name or 'nodes'!r} on body {body.name!r}"
        if (displacement is None) == (rotation is None):
            raise ModelError(f"{what}: give either displacement or rotation")
        slots = slots or ("position" if rotation is None else "all")
        support = Support(body, support_slots(nodes, slots), component_mask(components, what))
        if rotation is not None:
            if not isinstance(rotation, Rotation):
                raise ModelError(f"{what}: rotation must be a Rotation(anchor, axis, angle), got {rotation!r}")
            axis = vector(rotation.axis, f"{what}: axis")
            if not np.linalg.norm(axis) > 0.0:
                raise ModelError(f"{what}: axis is zero")
            support.law = time_law(rotation.angle, f"{what}: angle", scalar=True)
            support.rotation = (vector(rotation.anchor, f"{what}: anchor"), axis / np.linalg.norm(axis))
            self.description.supports.append(support)
            return
        moved = np.isin(support.slots, support_slots(nodes, "position"))
        if not moved.any():
            raise ModelError(f"{what}: slots = {slots!r} has no position to displace; clamp holds gradients")
        if not moved.all():  # gradients stay as they are
            self.description.supports.append(Support(body, support.slots[~moved], support.components))
        support.slots = support.slots[moved]
        if isinstance(displacement, tuple) and len(displacement) == 2 and np.ndim(displacement[1]) == 3:
            times, values = np.asarray(displacement[0], float), np.asarray(displacement[1], float)
            if values.shape != (len(times), len(nodes), 3):
                raise ModelError(f"{what}: values have shape {values.shape}, expected {(len(times), len(nodes), 3)}")
            used = np.flatnonzero(body.node_slot[nodes.indices] >= 0)
            support.node_laws = [time_law((times, values[:, k]), what) for k in used]
        else:
            support.law = time_law(displacement, f"{what}: displacement")
        self.description.supports.append(support)

    # loads

    def add_point_load(self, point: MaterialPoint | NodeSet, force: Any) -> None:
        """A force (time law, N) at a material point (Eq. 72), or shared equally by the nodes of a set."""
        body = self._own(point, "add_point_load", MaterialPoint, NodeSet)
        law = time_law(force, f"point load on {body.name!r}")
        if isinstance(point, NodeSet):
            slots = support_slots(point, "position")
            weights = np.full(len(slots), 1.0 / len(slots))
        else:
            slots, weights = point.slots, point.weights
        self.description.dead_loads.append(DeadLoad(body, slots, weights, law, "point load"))

    def add_moment(self, point: MaterialPoint | NodeSet, moment: Any) -> None:
        """A moment about fixed directions (time law (3,), N m), at a material point or shared equally by nodes.

        It does the work m . omega on the spin of the section (beams), of the director (shells; the part of the moment
        along the director does nothing), or of the deformation gradient (ANCF solids, and any solid at a point).

        Raises:
            ModelError: nodes without gradients to turn (T4, T10).
        """
        body = self._own(point, "add_moment", MaterialPoint, NodeSet)
        law = time_law(moment, f"moment on {body.name!r}")
        if isinstance(point, MaterialPoint):
            slots, vectors, axes = point.slots[None], (point.gradients @ point.axes)[None], point.axes[None]
        else:
            nodes = point.indices[body.node_slot_count[point.indices] == 4]
            if not len(nodes):
                raise ModelError(
                    f"add_moment: nodes of body {body.name!r} ({body.family.name}) have no gradients to turn; use a "
                    "point body.at(...), or add_traction"
                )
            slots = body.node_slot[nodes][:, None] + np.arange(1, 4)
            vectors = np.tile(np.eye(3), (len(slots), 1, 1))
            axes = np.swapaxes(body.reference[slots], 1, 2)
        vectors = vectors * (np.arange(3) >= 3 - body.family.spin_vectors)
        self.description.moments.append(Moment(body, slots, vectors, axes, law))

    def add_traction(self, surface: SurfaceSet, traction: Any) -> None:
        """A dead traction (time law (3,), N per m^2 of the reference area) on faces."""
        body = self._own(surface, "add_traction", SurfaceSet)
        law = time_law(traction, f"traction on {surface.name or 'faces'!r} of body {body.name!r}")
        slots, weights = surface_weights(surface)
        self.description.dead_loads.append(DeadLoad(body, slots, weights, law, "traction"))

    def add_pressure(self, surface: SurfaceSet, pressure: Any) -> None:
        """A follower pressure (time law, Pa) against the current outward normal of faces."""
        body = self._own(surface, "add_pressure", SurfaceSet)
        law = time_law(pressure, f"pressure on {surface.name or 'faces'!r} of body {body.name!r}", scalar=True)
        if not len(surface):
            raise ModelError(f"pressure on body {body.name!r}: the surface has no faces")
        self.description.pressures.append(Pressure(surface, law))

    def add_body_force(self, field: Any, *, bodies: list[Body] | None = None) -> None:
        """A force per mass b(x, t), N/kg, at the current position (Eq. 23).

        Args:
            field: wp.func (x: vec3, t: scalar) -> vec3, in the model's precision or in float32 or float64 as annotated.
            bodies: bodies it acts on; by default all that were added so far.
        """
        if not isinstance(field, wp.Function):
            raise ModelError(f"add_body_force: the field must be a wp.func, got {field!r}")
        if len(field.input_types) != 2:
            raise ModelError(
                f"add_body_force: {field.key} takes {len(field.input_types)} arguments; it must be "
                "(x: wp.vec3d, t: wp.float64) -> wp.vec3d, or the same in float32"
            )
        chosen = list(self.bodies if bodies is None else bodies)
        for body in chosen:
            self._own(body, "add_body_force", Body)
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
        self._own(body, "set_initial", Body)
        label = f"body {body.name!r}"
        if displacement is not None:
            body.initial_displacement = slot_field(body, displacement, f"{label}: initial displacement")
        if velocity is None and angular_velocity is None:
            return
        slots = np.zeros((body.slot_count, 3))
        if velocity is not None:
            slots += slot_field(body, velocity, f"{label}: velocity")
        if angular_velocity is not None:
            spin = vector(angular_velocity, f"{label}: angular_velocity")
            x = body.reference + (0.0 if body.initial_displacement is None else body.initial_displacement)
            position = body.slot_kind == 0
            arm = np.where(position[:, None], x + body.origin - center_of_mass(body, x), x)
            slots += np.cross(spin, arm)
        body.velocity = slots

    def add_probe(self, name: str, where: MaterialPoint | SurfaceSet | NodeSet) -> None:
        """Record a point at every step; of a surface its area mean, of nodes their mean."""
        body = self._own(where, "add_probe", MaterialPoint, SurfaceSet, NodeSet)
        if any(p.name == name for p in self.description.probes):
            raise ModelError(f"probe {name!r} is there already")
        if isinstance(where, MaterialPoint):
            slots, weights = where.slots, where.weights
        elif isinstance(where, SurfaceSet):
            slots, weights = surface_weights(where)
            weights = weights / weights[body.slot_kind[slots] == 0].sum()
        else:
            slots = support_slots(where, "position")
            weights = np.full(len(slots), 1.0 / len(slots))
        X = weights @ (body.reference[slots] + (body.slot_kind[slots] == 0)[:, None] * body.origin)
        self.description.probes.append(Probe(name, body, slots, weights, X))

    # joints

    def add_joint(
        self,
        kind: str,
        *,
        parent: Any,
        child: Any,
        anchor: Any = None,
        axis: Any = None,
        axis2: Any = None,
        drive: Any = None,
        name: str | None = None,
    ) -> Joint:
        """Tie two bodies, or a body and the ground, by a joint.

        Args:
            kind: "spherical", "universal", "revolute", "cylindrical", "translational", "fixed", or "distance" (a rod of
                constant length between two points).
            parent, child: wf.GROUND, a material point (body.at), nodes (body.nodes, beam.end), or a surface, whose mean
                place and turn count. A joint turns a solid best by a surface or several nodes: at a point of a solid
                the stress is singular, and the joint the softer the finer the mesh.
            anchor: (3,) m, where the joint is in the reference; by default where the child's handle is. Of a distance
                joint with the ground: the rod's end there.
            axis: (3,) of the hinge or the slide, or the parent's axis of a universal joint.
            axis2: the child's axis of a universal joint, perpendicular to `axis`; by default any such.
            drive: time law: angle (rad) of a revolute joint, the child against the parent, right-handed about the axis
                and of any number of turns; travel (m) of a translational joint, the child along the axis; length (m) of
                a distance joint. Angle and travel are 0 in the reference.
            name: unique name.

        Returns:
            Joint: the handle for sim.joint_force, sim.violation, sim.joint_record.

        Raises:
            ModelError: an unknown kind, handles that are apart without an anchor, points of a rod that coincide, a
                handle that does not tell how a direction turns, or an argument that does not belong to the kind.
        """
        name = self._joint_name(name, str(kind))
        for side, thing in (("parent", parent), ("child", child)):
            if not isinstance(thing, Ground):
                self._own(thing, f"joint {name!r}: {side}", MaterialPoint, NodeSet, SurfaceSet)
        return self._join(make_joint(kind, parent, child, anchor, axis, axis2, drive, name))

    def add_constraint(self, kind: str, *, points: Any, value: Any = None, name: str | None = None) -> Joint:
        """A single basic constraint between points (Paper I, section 5.4).

        Args:
            kind: "DP1", (Q - P).(T - R) = f m^2; "DP2", the same with R on the body of P and Q; "DIST", |P - Q| = f m,
                positive; "PIN", P - Q = f (3,) m.
            points: P, Q (, R, T): material points, nodes or surfaces (their mean), or fixed places (x, y, z), m.
            value: f, a time law; by default 0 of DP1, DP2 and PIN, and the reference distance of DIST.
            name: unique name.

        Raises:
            ModelError: an unknown kind, a wrong number of points, points that coincide where a direction is needed, or
                pinned points that are apart.
        """
        name = self._joint_name(name, str(kind))
        for k, point in enumerate(points if isinstance(points, (tuple, list)) else ()):
            if hasattr(point, "body"):
                self._own(point, f"constraint {name!r}: point {k + 1}", MaterialPoint, NodeSet, SurfaceSet)
        return self._join(make_constraint(kind, points, value, name))

    def weld(self, first: NodeSet | SurfaceSet, second: SurfaceSet | Body, *, name: str | None = None) -> Joint:
        """Tie a face to another body that it lies in, whatever the families: beam to solid, shell to solid, ...

        The gap between both vanishes in the mean with each shape function of the first face (a mortar tie): nothing is
        asked of the first body's section but what it can do. The first should be the coarser side.

        Args:
            first: a surface; beam.start, beam.end or a named edge of a shell (plate.edge) stand for their faces. Other
                nodes are pinned one by one.
            second: the body, or a surface of it, that holds the first.
            name: unique name.

        Raises:
            ModelError: a point of the first face that lies outside of the second body, or both are one body.
        """
        name = self._joint_name(name, "weld")
        self._own(first, f"weld {name!r}", NodeSet, SurfaceSet)
        self._own(second, f"weld {name!r}", SurfaceSet, Body)
        return self._join(make_weld(first, second, name))

    def _joint_name(self, name: str | None, kind: str) -> str:
        taken = {joint.name for joint in self.description.joints}
        if name is None:
            return next(n for k in itertools.count(1) if (n := f"{kind}_{k}") not in taken)
        if not isinstance(name, str) or not name:
            raise ModelError(f"joint name {name!r} is no text")
        if name in taken:
            raise ModelError(f"joint name {name!r} is used twice")
        return name

    def _join(self, joint: Joint) -> Joint:
        self.description.joints.append(joint)
        return joint

    # parts of later versions

    def add_collider(self, *args: Any, **options: Any) -> Any:
        """Contact is not part of this version."""
        raise NotImplementedError("add_collider: contact is not part of this version")

    def add_contact(self, *args: Any, **options: Any) -> Any:
        """Contact is not part of this version."""
        raise NotImplementedError("add_contact: contact is not part of this version")

    # the end

    def finalize(self, *, device: Any = None, dtype: str = "float64", worlds: int = 1) -> Model:
        """Make the constant Model of what was described.

        Args:
            device: Warp device, e.g. "cpu" or "cuda:0"; by default CUDA where there is one, else the CPU.
            dtype: "float64" or "float32".
            worlds: copies of the scene that are simulated side by side.

        Raises:
            ModelError: no bodies, unknown device or precision.
        """
        from ..model.model import Model

        return Model(self, device=device, dtype=dtype, worlds=worlds)

    def _name(self, name: str, *, given: bool) -> str:
        taken = {body.name for body in self.bodies}
        if name in taken:
            if given:
                raise ModelError(f"body name {name!r} is used twice")
            k = 2
            while f"{name}_{k}" in taken:
                k += 1
            name = f"{name}_{k}"
        return name

    def _own(self, thing: Any, what: str, *kinds: type) -> Body:
        """The body behind a handle, which must be of one of the kinds and of this builder."""
        body = thing if isinstance(thing, Body) else getattr(thing, "body", None)
        if not isinstance(body, Body):
            raise ModelError(f"{what}: expected a handle of a body (such as body.nodes(...)), got {thing!r}")
        if not isinstance(thing, kinds):
            wanted = " or ".join(HANDLES[kind] for kind in kinds)
            raise ModelError(f"{what}: expected {wanted} of body {body.name!r}, got {HANDLES[type(thing)]}")
        if body not in self.bodies:
            raise ModelError(f"{what}: body {body.name!r} belongs to another builder")
        if isinstance(thing, (NodeSet, SurfaceSet)) and len(thing) == 0:
            chosen = repr(thing.name) if thing.name else "of the predicate or list"
            raise ModelError(f"{what}: the selection {chosen} on body {body.name!r} is empty")
        if isinstance(thing, NodeSet):
            unused = thing.indices[body.node_slot[thing.indices] < 0]
            if len(unused) == len(thing.indices):
                raise ModelError(f"{what}: no element of body {body.name!r} uses node {int(unused[0])}")
        return body
