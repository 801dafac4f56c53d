"""ModelBuilder: what a user says of a scene, checked as it is said."""

from __future__ import annotations

import math
import pathlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from . import elements
from . import mesh as meshes
from .bodies import Body, ElementSet, MaterialPoint, NodeSet, SurfaceSet
from .errors import ModelError
from .laws import TimeLaw, time_law
from .materials import Material
from .mesh import Mesh

if TYPE_CHECKING:
    from .model import Model

__all__ = ["ModelBuilder", "Rotation"]

COMPONENTS = {"x": 0, "y": 1, "z": 2}
HANDLES: dict[type, str] = {
    Body: "the body",
    NodeSet: "nodes (body.nodes)",
    SurfaceSet: "a surface (body.surface)",
    ElementSet: "elements (body.elements)",
    MaterialPoint: "a point (body.at)",
}


@dataclass(frozen=True, eq=False)
class Rotation:
    """A prescribed rotation about an axis through an anchor.

    Args:
        anchor: (3,) m.
        axis: (3,), any length but zero.
        angle: time law, rad.
    """

    anchor: Any
    axis: Any
    angle: Any


@dataclass(eq=False)
class DeadLoad:
    """Force weight_i x value(t) on slots; kept for point loads and tractions alike."""

    body: Body
    slots: np.ndarray
    weights: np.ndarray
    law: TimeLaw
    name: str


@dataclass(eq=False)
class Pressure:
    """Follower pressure on faces."""

    surface: SurfaceSet
    law: TimeLaw


@dataclass(eq=False)
class BodyForce:
    """Field b(r, t) on bodies, N/kg."""

    function: Any
    bodies: list[Body]


@dataclass(eq=False)
class Support:
    """Prescribed components of slots: clamped (no law), moved by a law, or rotated."""

    body: Body
    slots: np.ndarray
    components: np.ndarray
    law: TimeLaw | None = None
    node_laws: list[TimeLaw] | None = None
    rotation: tuple[np.ndarray, np.ndarray] | None = None


@dataclass(eq=False)
class Probe:
    """A recorded point: sum of weights x slot values."""

    name: str
    body: Body
    slots: np.ndarray
    weights: np.ndarray
    X: np.ndarray


@dataclass(eq=False)
class Description:
    """All that a builder has collected."""

    bodies: list[Body] = field(default_factory=list)
    supports: list[Support] = field(default_factory=list)
    dead_loads: list[DeadLoad] = field(default_factory=list)
    pressures: list[Pressure] = field(default_factory=list)
    body_forces: list[BodyForce] = field(default_factory=list)
    probes: list[Probe] = field(default_factory=list)


class ModelBuilder:
    """Collects bodies, supports and loads; `finalize` makes a Model of them.

    Args:
        gravity: (3,) m/s^2.
        up_axis: "Z" or "Y", for outputs.

    Raises:
        ModelError: gravity is not three finite numbers, or the axis is unknown.
    """

    def __init__(self, gravity: Any = (0.0, 0.0, -9.81), up_axis: str = "Z") -> None:
        self.gravity = _vector(gravity, "gravity")
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
            element: element family; by default T4 or T10 as the cells are.
            quadrature: name of the force rule of all elements; T10: "tet4", "tet5_paper", "tet8", "tet14"; T4: "tet1",
                "tet4". By default T10 takes "tet4" where straight and "tet8" where curved, T4 "tet1".
            scale: factor on the coordinates of the file.
            transform: (4, 4) matrix, or (rotation (3, 3), translation (3,)), applied after `scale`.
            initial: initial positions, (nodes, 3) in m or a function X (nodes, 3) -> (nodes, 3), where they differ from
                the stress-free reference.
            name: unique name; by default the mesh's.

        Raises:
            MeshError: the file or mesh can't be used.
            ModelError: unknown group or rule, elements without material, a name used twice.
        """
        if isinstance(mesh, (str, pathlib.Path)):
            mesh = meshes.read(mesh, scale=scale, transform=transform)
        elif not isinstance(mesh, Mesh):
            raise ModelError(f"add_solid: mesh must be a file name or a Mesh, got {type(mesh).__name__}")
        else:
            if scale != 1.0 or transform is not None:
                mesh = mesh.transformed(scale=scale, transform=transform)
            meshes.check(mesh)
        name = self._name(name or mesh.name, given=name is not None)
        if len(mesh.cells) == 0:
            raise ModelError(f"body {name!r}: the mesh has no elements")
        family = elements.get(element) if element else elements.for_cell(mesh.cell_type)
        if family.cell_type != mesh.cell_type:
            raise ModelError(
                f"body {name!r}: element {family.name} needs {family.cell_type} cells, the mesh has {mesh.cell_type}"
            )
        materials, index = _assign_materials(name, mesh, material)
        rule = family.rule(quadrature).name
        curved = family.curved_rule.name if quadrature is None else rule
        body = Body(name, mesh, family, materials, index, rule, curved)
        body.index = len(self.bodies)
        if initial is not None:
            body.initial_displacement = _initial(body, initial)
        self.bodies.append(body)
        return body

    def add_beam(self, *args: Any, **options: Any) -> Body:
        """ANCF beams are not part of this version."""
        raise NotImplementedError("add_beam: ANCF beams (3243) are not part of this version")

    def add_shell(self, *args: Any, **options: Any) -> Body:
        """ANCF shells are not part of this version."""
        raise NotImplementedError("add_shell: ANCF shells (3443) are not part of this version")

    # supports

    def clamp(self, nodes: NodeSet, *, slots: str = "all", components: str = "xyz") -> None:
        """Hold nodes at their initial place.

        Args:
            nodes: what to hold.
            slots: "all", or "position" to leave gradients free.
            components: which of "xyz" to hold.
        """
        body = self._own(nodes, "clamp", NodeSet)
        self.description.supports.append(
            Support(body, _support_slots(nodes, slots), _components(components, f"clamp on {body.name!r}"))
        )

    def drive(
        self,
        nodes: NodeSet,
        *,
        displacement: Any = None,
        rotation: Rotation | None = None,
        components: str = "xyz",
        slots: str = "position",
    ) -> None:
        """Move nodes on a prescribed path.

        Args:
            nodes: what to move.
            displacement: time law of the displacement from the reference (3,), m, or (times (n,), values
                (n, nodes, 3)).
            rotation: Rotation about an axis, from the reference.
            components: which of "xyz" are prescribed.
            slots: "position", or "all" for gradients too (rotation only).

        Raises:
            ModelError: neither or both of displacement and rotation, or a wrong shape.
        """
        body = self._own(nodes, "drive", NodeSet)
        what = f"drive of {nodes.name or 'nodes'!r} on body {body.name!r}"
        if (displacement is None) == (rotation is None):
            raise ModelError(f"{what}: give either displacement or rotation")
        support = Support(body, _support_slots(nodes, slots), _components(components, what))
        if rotation is not None:
            if not isinstance(rotation, Rotation):
                raise ModelError(f"{what}: rotation must be a Rotation(anchor, axis, angle), got {rotation!r}")
            axis = _vector(rotation.axis, f"{what}: axis")
            if not np.linalg.norm(axis) > 0.0:
                raise ModelError(f"{what}: axis is zero")
            support.law = time_law(rotation.angle, f"{what}: angle", scalar=True)
            support.rotation = (_vector(rotation.anchor, f"{what}: anchor"), axis / np.linalg.norm(axis))
        elif isinstance(displacement, tuple) and len(displacement) == 2 and np.ndim(displacement[1]) == 3:
            times, values = np.asarray(displacement[0], float), np.asarray(displacement[1], float)
            if values.shape != (len(times), len(nodes), 3):
                raise ModelError(f"{what}: values have shape {values.shape}, expected {(len(times), len(nodes), 3)}")
            support.slots = _support_slots(nodes, "position")
            support.node_laws = [time_law((times, values[:, k]), what) for k in range(len(nodes))]
        else:
            support.law = time_law(displacement, f"{what}: displacement")
        self.description.supports.append(support)

    # loads

    def add_point_load(self, point: MaterialPoint | NodeSet, force: Any) -> None:
        """A force (time law, N) at a material point (Eq. 72), or shared equally by the nodes of a set."""
        body = self._own(point, "add_point_load", MaterialPoint, NodeSet)
        law = time_law(force, f"point load on {body.name!r}")
        if isinstance(point, NodeSet):
            slots = _support_slots(point, "position")
            weights = np.full(len(slots), 1.0 / len(slots))
        else:
            slots, weights = point.slots, point.weights
        self.description.dead_loads.append(DeadLoad(body, slots, weights, law, "point load"))

    def add_moment(self, point: Any, moment: Any) -> None:
        """Moments act on gradient slots, which solids of this version do not have."""
        raise NotImplementedError("add_moment: moments act on ANCF nodes, which are not part of this version")

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
            velocity: (3,) or (nodes, 3), m/s.
            angular_velocity: (3,) rad/s about the centre of mass.
            displacement: (nodes, 3) m, or a function X (nodes, 3) -> (nodes, 3).
        """
        self._own(body, "set_initial", Body)
        N = len(body.mesh.points)
        if displacement is not None:
            values = displacement(body.mesh.points) if callable(displacement) else displacement
            body.initial_displacement = _nodal(values, N, f"body {body.name!r}: initial displacement")
        if velocity is None and angular_velocity is None:
            return
        total = np.zeros((N, 3))
        if velocity is not None:
            values = velocity(body.mesh.points) if callable(velocity) else velocity
            total += _nodal(values, N, f"body {body.name!r}: velocity")
        spin = np.zeros(3)
        if angular_velocity is not None:
            spin = _vector(angular_velocity, f"body {body.name!r}: angular_velocity")
            x = body.mesh.points + (0.0 if body.initial_displacement is None else body.initial_displacement)
            total += np.cross(spin, x - center_of_mass(body, x))
        slots = total[body.slot_node]
        gradient = body.slot_kind > 0
        slots[gradient] = np.cross(spin, body.reference[gradient])
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
            weights = weights / weights.sum()
        else:
            slots = _support_slots(where, "position")
            weights = np.full(len(slots), 1.0 / len(slots))
        X = weights @ (body.reference[slots] + (body.slot_kind[slots] == 0)[:, None] * body.origin)
        self.description.probes.append(Probe(name, body, slots, weights, X))

    # parts of later versions

    def add_joint(self, *args: Any, **options: Any) -> Any:
        """Joints are not part of this version."""
        raise NotImplementedError("add_joint: joints are not part of this version")

    def add_constraint(self, *args: Any, **options: Any) -> Any:
        """Constraints are not part of this version."""
        raise NotImplementedError("add_constraint: constraints are not part of this version")

    def weld(self, *args: Any, **options: Any) -> Any:
        """Welds are not part of this version."""
        raise NotImplementedError("weld: constraints are not part of this version")

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
        from .model import Model

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
            raise ModelError(f"{what}: the selection {thing.name!r} on body {body.name!r} is empty")
        if isinstance(thing, NodeSet):
            unused = thing.indices[body.node_slot[thing.indices] < 0]
            if len(unused) == len(thing.indices):
                raise ModelError(f"{what}: no element of body {body.name!r} uses node {int(unused[0])}")
        return body


def _vector(value: Any, what: str) -> np.ndarray:
    try:
        out = np.asarray(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise ModelError(f"{what} = {value!r} is not three numbers") from error
    if out.shape != (3,) or not np.all(np.isfinite(out)):
        raise ModelError(f"{what} = {value!r} is not three finite numbers")
    return out


def _nodal(values: Any, nodes: int, what: str) -> np.ndarray:
    out = np.asarray(values, dtype=float)
    if out.shape == (3,):
        out = np.broadcast_to(out, (nodes, 3))
    if out.shape != (nodes, 3):
        raise ModelError(f"{what} has shape {out.shape}, expected (3,) or {(nodes, 3)}")
    bad = np.flatnonzero(~np.isfinite(out).all(axis=1))
    if len(bad):
        raise ModelError(f"{what}: node {int(bad[0])} has {out[bad[0]].tolist()}")
    return out.copy()


def _initial(body: Body, initial: Any) -> np.ndarray:
    values = initial(body.mesh.points) if callable(initial) else initial
    return _nodal(values, len(body.mesh.points), f"body {body.name!r}: initial") - body.mesh.points


def _components(text: str, what: str) -> np.ndarray:
    out = np.zeros(3)
    if not text or any(c not in COMPONENTS for c in text):
        raise ModelError(f"{what}: components = {text!r} must be letters of 'xyz'")
    for c in text:
        out[COMPONENTS[c]] = 1.0
    return out


def _support_slots(nodes: NodeSet, which: str) -> np.ndarray:
    """Body slots of a node set: of all kinds, or positions."""
    if which not in ("all", "position"):
        if which == "position+axis":
            raise NotImplementedError("slots='position+axis': ANCF nodes are not part of this version")
        raise ModelError(f"slots = {which!r} is none of 'position', 'position+axis', 'all'")
    body = nodes.body
    first = body.node_slot[nodes.indices]
    first = first[first >= 0]
    if which == "position":
        return first
    counts = body.node_slot_count[body.slot_node[first]]
    return np.concatenate([f + np.arange(c) for f, c in zip(first, counts)]) if len(first) else first


def _assign_materials(name: str, mesh: Mesh, material: Any) -> tuple[list[tuple[str, Material]], np.ndarray]:
    if isinstance(material, Material):
        _check_density_length(name, "", material, len(mesh.cells), mesh)
        return [("", material)], np.zeros(len(mesh.cells), dtype=np.int64)
    if not isinstance(material, dict) or not all(isinstance(m, Material) for m in material.values()):
        raise ModelError(f"body {name!r}: material must be a law or a dict of group name to law, got {material!r}")
    index = np.full(len(mesh.cells), -1, dtype=np.int64)
    for k, (group, law) in enumerate(material.items()):
        if group not in mesh.element_sets:
            raise ModelError(
                f"body {name!r}: material group {group!r} is not an element group of {mesh.label}; there are "
                f"{sorted(mesh.element_sets)}"
            )
        members = mesh.element_sets[group]
        twice = members[index[members] >= 0]
        if len(twice):
            raise ModelError(f"body {name!r}: element {int(twice[0])} is in two material groups, one of them {group!r}")
        index[members] = k
        _check_density_length(name, group, law, len(mesh.cells), mesh)
    bare = np.flatnonzero(index < 0)
    if len(bare):
        raise ModelError(
            f"body {name!r}: {len(bare)} elements of {mesh.label} have no material, the first is element "
            f"{int(bare[0])}; groups given: {sorted(material)}"
        )
    return list(material.items()), index


def _check_density_length(name: str, group: str, material: Any, elements_count: int, mesh: Mesh) -> None:
    density = material.density
    if callable(density):
        values = np.asarray(density(mesh.points), dtype=float)
        if values.shape != (len(mesh.points),) or not np.all(np.isfinite(values) & (values > 0.0)):
            raise ModelError(f"body {name!r}: density f(X) must give one positive finite value per point")
    elif np.ndim(density) == 1 and len(density) != elements_count:
        raise ModelError(
            f"body {name!r}: density of group {group!r} has {len(density)} values for {elements_count} elements"
        )


def surface_weights(surface: SurfaceSet) -> tuple[np.ndarray, np.ndarray]:
    """Integral of each shape function over faces: body slots and weights (m^2); Gauss points, curved faces too."""
    from .assembly import facet_tables

    body = surface.body
    conn, s, a, b, w = facet_tables(surface)
    x = body.reference[conn]
    normal = np.cross(np.einsum("qi,fik->fqk", a, x), np.einsum("qi,fik->fqk", b, x))
    dA = np.linalg.norm(normal, axis=2) * w[None, :]
    weights = np.einsum("fq,qi->fi", dA, s)
    slots, inverse = np.unique(conn, return_inverse=True)
    return slots, np.bincount(inverse.ravel(), weights=weights.ravel(), minlength=len(slots))


def center_of_mass(body: Body, x: np.ndarray) -> np.ndarray:
    """Centre of mass (m) of a body with nodes at x (nodes, 3)."""
    from .assembly import body_mass

    position = body.slot_kind == 0
    lumped = body_mass(body) @ position.astype(float)
    out = (lumped[position] @ x[body.slot_node[position]]) / lumped[position].sum()
    assert math.isfinite(float(out.sum()))
    return out
