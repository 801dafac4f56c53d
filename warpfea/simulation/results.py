"""Results at the current state: positions, velocities, fields, drawn surface; time histories of probes, joints and
contacts."""

from __future__ import annotations

import warnings
import weakref
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..base.errors import ModelError, ModelWarning
from ..base.names import check_choice, did_you_mean, listing
from ..base.worlds import world_numbers
from ..kernels.contact.structs import RECORD_NAMES
from ..kernels.step.step_control import REPORT_COLUMNS
from ..kernels.terms.constraints import JOINT_COLUMNS
from ..model.bodies import Body, point_coordinates
from ..model.contacts import Contact, ContactOptions
from ..model.description import support_slots
from ..model.handles import ElementSet, NodeSet
from ..model.joints import Joint
from ..model.pairs import FacetOptions
from ..model.rigid import RigidBody
from ..model.springs import Bushing, Spring
from ..model.state import State
from ..model.surfaces import reference_points
from ..terms.fields import check_scalar, field_at_nodes, field_drawn, field_inside, find_field
from ..terms.joint_values import joint_value
from ..terms.protocols import Touching
from ..terms.springs import Springs
from ..terms.term import FieldSpec
from .reports import ContactRecord, JointRecord, ProbeRecord
from .sampling import RECORDED_FIELDS, History, accelerations, joint_history, sampler, step_loads

if TYPE_CHECKING:
    from ..model.model import Model
    from .reports import RunStatistics
    from .stepper import Stepper

__all__ = ["PartMember", "Records", "Results"]

MAX_NAMED_BODIES = 5
"""Maximum number of bodies named in a message."""


class Results:
    """Results of the present state of a model. Nodal results are in the mesh file's order, worlds first.

    Attributes:
        records: of the simulation; None of a state alone.
    """

    records: Records | None = None

    def __init__(self, model: Model, state: State) -> None:
        self.model, self.state = model, state

    def check_body(self, body: Any, what: str) -> None:
        """Raise ModelError unless `body` is the handle of a body of this model; the text begins with `what`."""
        if not isinstance(body, Body):
            names = ", ".join(repr(b.name) for b in self.model.bodies[:MAX_NAMED_BODIES])
            if len(self.model.bodies) > MAX_NAMED_BODIES:
                names += f" and {len(self.model.bodies) - MAX_NAMED_BODIES} more"
            raise ModelError(
                f"{what}: expected a body, by the handle that add_solid, add_beam, add_shell or add_rigid returned (of "
                f"{names}), got {body!r}"
            )
        if body not in self.model.bodies:
            raise ModelError(f"{what}: body {body.name!r} is not of this model")

    def at_mesh_nodes(self, body: Body, values: np.ndarray) -> np.ndarray:
        """Slot values at mesh nodes, (B, nodes, 3); 0 at nodes without an element."""
        return body.at_nodes(values[:, body.slot_range])

    def displacements(self, body: Body) -> np.ndarray:
        """Nodal displacements (B, nodes, 3), m, in the mesh file's order. ModelError for a body of another model."""
        self.check_body(body, "displacements")
        return self.at_mesh_nodes(body, self.state.displacement.numpy())

    def positions(self, body: Body) -> np.ndarray:
        """Nodal positions (B, nodes, 3), m. ModelError for a body of another model."""
        self.check_body(body, "positions")
        return body.mesh.points + self.displacements(body)

    def velocities(self, body: Body) -> np.ndarray:
        """Nodal velocities (B, nodes, 3), m/s. ModelError for a body of another model."""
        self.check_body(body, "velocities")
        return self.at_mesh_nodes(body, self.state.velocity.numpy())

    def pose(self, part: RigidBody | str) -> tuple[np.ndarray, np.ndarray]:
        """Centre of mass (B, 3), m, rotation from the reference, quaternions (B, 4), x y z w; of a handle or name."""
        part = self.rigid_part(part, "pose")
        u = self.state.displacement.numpy()[:, part.slots].astype(float)
        return part.com + part.affine[0] @ u, Rotation.from_matrix(np.eye(3) + part.rotation_of(u)).as_quat()

    def angular_velocity(self, part: RigidBody | str) -> np.ndarray:
        """Angular velocity (B, 3), rad/s, in the axes of the scene, from dA/dt A^T (Paper I, Eqs. (12)-(14))."""
        part = self.rigid_part(part, "angular_velocity")
        u, v = (x.numpy()[:, part.slots].astype(float) for x in (self.state.displacement, self.state.velocity))
        spin = part.rotation_of(v) @ np.swapaxes(np.eye(3) + part.rotation_of(u), 1, 2)
        return 0.5 * np.stack([spin[:, i, j] - spin[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=1)

    def rigid_part(self, part: Any, what: str) -> RigidBody:
        """The rigid part of this model of a handle or a name; the text of a ModelError begins with `what`."""
        self.check_body(part := next((body for body in self.model.bodies if body.name == part), part), what)
        if not isinstance(part, RigidBody):
            raise ModelError(f"{what}: body {part.name!r} is flexible; positions and velocities give its motion")
        return part

    def point_positions(self, body: Body, weights: Any, worlds: Sequence[int] | None = None) -> np.ndarray:
        """Positions (B, P, 3), m, of points given by sparse weights (P, slots of the body), in all worlds or some."""
        sums, worlds = self.model.terms.evaluation.samples.slot_sums, world_numbers(worlds, self.model.worlds)
        return reference_points(body, weights) + sums(self.state.displacement, weights, worlds, body.slot_offset)

    def skin_points(self, body: Body, worlds: Sequence[int] | None = None) -> np.ndarray:
        """Points (B, skin points, 3), m, of the drawn surface, in all worlds or some."""
        self.check_body(body, "skin_points")
        return self.point_positions(body, body.skin.slot_weights, worlds)

    def skin_field(self, name: str, body: Body, worlds: Sequence[int] | None = None) -> np.ndarray:
        """Scalar field (B, skin points) at the drawn surface, in all worlds or some."""
        self.check_body(body, "skin_field")
        return self.field_on(name, body, body.skin, worlds)

    def collider_poses(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Collider poses: positions (B, K, 3), m, rotations (B, K, 3, 3) with the shape's axes in the world as columns,
        and surface offsets (B, K), m; None for a model without contact."""
        return next((poses for term in self.model.terms.contacts if (poses := term.poses(self.state))), None)

    @property
    def fields(self) -> dict[str, FieldSpec]:
        """Available fields, by name."""
        return self.model.terms.fields | (RECORDED_FIELDS if self.records else {})

    def check_field(self, name: str, *, scalar: bool = False) -> None:
        """Raise ModelError, listing the available names, unless `name` is a field, and a scalar where one is needed."""
        find_field(self, name)
        if scalar:
            check_scalar(self, name)

    def field_on(self, name: str, body: Body, drawn: Any, worlds: Sequence[int] | None = None) -> np.ndarray:
        """Field (B, P), or (B, P, k), at the points of a Skin or Drawing of the body, in all worlds or some."""
        find_field(self, name)
        if name.partition(".")[0] in RECORDED_FIELDS:
            raise ModelError(f"field {name!r} is one of nodes: it is not drawn")
        worlds = world_numbers(worlds, self.model.worlds)
        return field_drawn(self.model.terms, name, body, self.state, drawn, worlds)

    def field(self, name: str, body: Body, *, at: str = "nodes", elements: ElementSet | None = None) -> np.ndarray:
        """A field at the nodes of a body, (B, nodes), or (B, nodes, k) with components, listed by `fields`.

        Scalars such as "von_mises", "tresca", "pressure", "J", "strain_energy_density"; "cauchy", "second_piola",
        "green_lagrange", "almansi" (6: xx yy zz yz xz xy), "first_piola" (9, row by row), "principal" (3, largest
        first), "velocity" (3); "cauchy.xx" is a component; with contact "contact_pressure" and "gap" (NaN off surfaces
        in contact). Stresses are elastic. "displacement" is its size. Nodes of beams and shells have the maximum over
        the corners of the section or both faces, of J the minimum, and the mean of components.

        Args:
            at: "nodes", averaged over the elements of a material (nodes between materials have that given first);
                "elements", means (B, elements); "points", quadrature points (B, elements, points).
            elements: the elements that count at nodes, such as body.elements("rubber"); NaN at other nodes.
        """
        self.check_body(body, "field(name, body)")
        check_choice("field: at", at, ("nodes", "elements", "points"))
        spec, whole = find_field(self, name), name.partition(".")[0]
        if self.records and whole in RECORDED_FIELDS and at == "nodes":
            values = self.records.at_nodes(whole, body)
            return np.asarray(spec.function(values)) if spec.function else values
        if elements is not None and at != "nodes":
            raise ModelError(f"field: elements= chooses what counts at nodes; take rows {elements!r} of at={at!r}")
        if at != "nodes":
            return field_inside(self.model.terms, name, body, self.state, at)
        if elements is not None and (not isinstance(elements, ElementSet) or elements.body is not body):
            raise ModelError(f"field: elements = {elements!r} must be elements of body {body.name!r}")
        chosen = None if elements is None else elements.indices
        return field_at_nodes(self.model.terms, name, body, self.state, chosen)

    def sample(self, points: Any, name: str) -> np.ndarray:
        """A field (B, P), or (B, P, k), at material points: one, or several as `body.at` and `body.line` give them, or
        nodes of a body, which "acceleration" and "reaction" take alone."""
        return sampler(self, points, name)()

    def node_gradients(self, body: Body) -> np.ndarray:
        """Deformation gradient F (B, nodes, 3, 3) at the nodes of a body with gradient slots; NaN at others.

        For a beam or shell, F maps the node's reference axes (body.node_axes) to the present ones.
        """
        self.check_body(body, "node_gradients")
        if not body.family.has_gradients:
            raise ModelError(
                f"body {body.name!r}: element {body.family.name} has no nodal gradients (F at nodes exists for ANCF "
                "elements only)"
            )
        out = np.full((self.model.worlds, len(body.mesh.points), 3, 3), np.nan)
        u = self.state.displacement.numpy()[:, body.slot_range].astype(float)
        nodes = np.flatnonzero(body.node_slot_count == 4)
        rows = body.node_slot[nodes][:, None] + np.arange(1, 4)
        out[:, nodes] = np.eye(3) + np.einsum("bnkc,nkd->bncd", u[:, rows], body.reference[rows])
        return out


class Records:
    """Results of the last step and over time: energies, reactions, probes, joints and contacts."""

    def __init__(self, results: Results, stepper: Stepper, statistics: RunStatistics) -> None:
        self.results, self.stepper, self.statistics = results, stepper, statistics
        self.warned_of_noise = False
        self.model, self.state = results.model, results.state
        self.histories: list[History] = []
        self.state.step_loads = partial(step_loads, weakref.ref(stepper), statistics)

    def energies(self) -> dict[str, np.ndarray]:
        """Energy ledger, each (B,), J.

        work_joints is the force at the end of each substep times the drive's travel, as in the scheme; `integrator`
        contains the difference to the exact work, and may be negative.

        kinetic, strain and potential (of gravity, from the reference) are current values. work (by loads, supports,
        fields and driven joints, also listed separately), viscous, contact, friction and integrator accumulate from the
        start; ledger_residual is change of energy + losses - work, which equals `unbalanced`, the sum of g . dq left by
        the solver's tolerance.
        """
        if not self.stepper.ledger:
            raise ModelError("energies: the simulation was made with ledger=False")
        return self.model.terms.energies(self.state.ledger.numpy())

    def reaction(self, nodes: NodeSet) -> np.ndarray:
        """Force of the supports on the prescribed components of nodes at the last accepted step, (B, 3), N.

        NaN for a world whose last step was rejected, or without a step since a reset or resumption.
        """
        return self._reactions(nodes, "position")[1].sum(axis=1)

    def reaction_moment(self, nodes: NodeSet, about: Any = (0.0, 0.0, 0.0)) -> np.ndarray:
        """Moment of the supports about a point (3,), m, on the prescribed components of nodes, gradients included, at
        the last accepted step, (B, 3), N m. NaN as for `reaction`."""
        slots, g = self._reactions(nodes, "all")
        body, point = nodes.body, point_coordinates(nodes.body, about)
        x = body.reference[slots] + self.state.displacement.numpy()[:, body.slot_range][:, slots].astype(float)
        x = x + (body.slot_kind[slots] == 0)[:, None] * (body.origin - point)
        return np.asarray(np.cross(x, g).sum(axis=1))

    def _reactions(self, nodes: Any, slots: str) -> tuple[np.ndarray, np.ndarray]:
        """Body slots of nodes, and the forces (B, slots, 3) of the supports on them."""
        if not isinstance(nodes, NodeSet):
            raise ModelError(f"reaction: expected nodes (body.nodes), got {nodes!r}")
        self.results.check_body(nodes.body, "reaction")
        g = self.stepper.work.g.numpy() * (1.0 - self.model.slot_table.free)
        rows = support_slots(nodes, slots)
        of_nodes = g[:, nodes.body.slot_offset + rows].astype(float)
        of_nodes[~self.statistics.stepped_worlds] = np.nan
        return rows, of_nodes

    def history(self, name: str, points: Any) -> History:
        """Record a field at material points or nodes after each further step, as `sample`; "reaction", force and moment
        about the origin (6) of the supports on nodes; or "angle", "travel", "length" of a joint, plotted by `plot`."""
        if self.statistics.asynchronous:
            raise ModelError("history: the simulation was made with record=False")
        if name == "reaction":
            self._reactions(points, "position")
            out = History(lambda: np.concatenate([self.reaction(points), self.reaction_moment(points)], axis=1))
        elif name in ("angle", "travel", "length"):
            out = joint_history(self, name, points)
        else:
            out = History(sampler(self.results, points, name))
        self.histories.append(out)
        return out

    def at_nodes(self, name: str, body: Body) -> np.ndarray:
        """A field of RECORDED_FIELDS (B, nodes, 3) at the last accepted step; NaN as for `reaction`."""
        if name == "reaction":
            values = self.stepper.work.g.numpy() * (1.0 - self.model.slot_table.free)
        else:
            values = accelerations(self.stepper)
        out = self.results.at_mesh_nodes(body, values.astype(float))
        out[~self.statistics.stepped_worlds] = np.nan
        return out

    def probe(self, name: str) -> ProbeRecord:
        """Record of the probe `name`, one entry per step. Raises ModelError listing the probes."""
        names = [p.name for p in self.model.description.probes]
        if name not in names:
            raise ModelError(f"probe {name!r} is unknown; there are: {listing(names)}{did_you_mean(name, names)}")
        k = names.index(name)
        time, table = self._recorded_table(len(REPORT_COLUMNS) + 6 * k, 6)
        d, v = table[:, :, :3], table[:, :, 3:]
        return ProbeRecord(time, self.model.description.probes[k].X + d, d, v)

    def _recorded_table(self, first: int, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Times (steps,), s, or (B, steps) with times per world, and values (B, steps, count) of the columns of the
        report from `first`, one of a probe or later, on."""
        first += 1 - len(REPORT_COLUMNS)
        table = np.zeros((self.model.worlds, 0, 1 + count))
        if self.statistics.history:
            table = np.stack([rows[:, [0, *range(first, first + count)]] for rows in self.statistics.history], axis=1)
        time = table[:, :, 0]
        return time if self.statistics.times_differ else time.max(axis=0), table[:, :, 1:]

    def _of_last_step(self, first: int) -> np.ndarray:
        """(B, 6) report columns of the last accepted step; NaN for worlds without."""
        out = self.stepper.work.report.numpy()[:, first : first + 6].copy()
        out[~self.statistics.stepped_worlds] = np.nan
        return out

    def warn_of_noise(self) -> None:
        """Warn, once, of joint forces in float32 after steps that ended at its round-off: they carry that of the stress
        in stiff bodies, which the positions and the error estimate of those steps do not show."""
        floored = int(self.statistics.totals["floored"].sum())
        if self.warned_of_noise or self.model.dtype != "float32" or not floored:
            return
        self.warned_of_noise = True
        warnings.warn(
            f"joint forces: {floored} of {self.statistics.steps * self.model.worlds} steps ended where float32 rounds "
            "the stress; forces and moments of joints may be off by more than the loads; take dtype='float64'",
            ModelWarning,
            stacklevel=3,
        )

    def joint_record(self, joint: Joint | str) -> JointRecord:
        """Record of a joint (handle or name), one entry per step. Warns as `joint_force`."""
        self.warn_of_noise()
        time, table = self._recorded_table(self.joint_column(joint), JOINT_COLUMNS)
        return JointRecord(time, table[:, :, :3], table[:, :, 3:6], table[:, :, 6])

    def joint_force(self, joint: Joint | str) -> np.ndarray:
        """Force (N) and moment about the anchor (N m) that a joint exerts on its child at the last accepted step.

        (B, 6) in world axes; over time see `joint_record`. NaN as for `reaction`. Warns (ModelWarning) in float32 after
        steps that ended at its round-off (`report.floor` above 0).
        """
        self.warn_of_noise()
        return self._of_last_step(self.joint_column(joint))

    def spring_force(self, spring: Spring | Bushing | str) -> np.ndarray:
        """Torque (N m) or force (N), (B,), of an actuator, stop, friction or spring on a joint's child, tension of one
        between points, force and moment about its second end (B, 6) of a bushing on that end, force (B, 3) of a
        foundation on its body; at the last accepted step. NaN as for `reaction`."""
        d, term = self.model.description, self.model.terms.find(Springs)
        things = [*d.bushings, *(s for s in d.springs if s.keys != {})]
        force = term.force_of(self.stepper.ctx, _find("spring", spring, things, "a handle, or a name"))
        return np.where(self.statistics.stepped_worlds, force.T, np.nan).T

    def violation(self, joint: Joint | str) -> np.ndarray:
        """Largest violation of a joint's rows in the present state, (B,), m; angles are multiplied by the model's
        size."""
        k = self.find_joint(joint).index
        constraints = self.model.constraints
        assert constraints is not None
        values = np.abs(self.model.evaluation.constraint_values(self.state)[:, constraints.rows_of[k]]).max(axis=1)
        # right-hand sides of the last step if it led to this state: statics resets its time
        column = self.joint_column(joint) + 6
        return np.where(self.statistics.stepped_worlds, self.stepper.work.report.numpy()[:, column], values)

    def joint_value(self, joint: Joint | str, what: str | None = None) -> np.ndarray:
        """Angle (rad) of a revolute or cylindrical joint, travel (m) of a translational, length (m) of a distance.

        (B,), in the present state; angles count full turns, as long as no step turns by more than half of one. `what`:
        "angle", "travel" or "length" if a joint has several. Travel is along the parent's axis, per unit of its
        reference.
        """
        return self._joint_value(joint, what, rate=False)

    def joint_rate(self, joint: Joint | str, what: str | None = None) -> np.ndarray:
        """Rate of change of `joint_value`, rad/s or m/s (B,), of the present velocities."""
        return self._joint_value(joint, what, rate=True)

    def _joint_value(self, joint: Joint | str, what: str | None, *, rate: bool) -> np.ndarray:
        known = self.find_joint(joint)
        constraints = self.model.constraints
        assert constraints is not None
        return joint_value(constraints, known, what, self.state, rate=rate)

    def joint_column(self, joint: Joint | str) -> int:
        """First report column of a joint."""
        known = self.find_joint(joint)
        return self.model.terms.constraints.report_offset + JOINT_COLUMNS * known.index

    def find_joint(self, joint: Joint | str) -> Joint:
        """Joint of this model by handle or name."""
        joints = self.model.constraints.joints if self.model.constraints else []
        return _find("joint", joint, joints, "a handle from add_joint, add_constraint or weld, or a name")

    def contact_record(self, contact: Contact | FacetOptions | str) -> ContactRecord:
        """Record of a contact (handle or name), one entry per step."""
        time, table = self._recorded_table(self.contact_column(contact), len(RECORD_NAMES))
        names = ("normal_force", "penetration", "slip", "area", "stick", "stored", "loss", "friction", "collider_work")
        scalars = {name: table[:, :, RECORD_NAMES.index(name)] for name in names}
        return ContactRecord(time, table[:, :, :3], table[:, :, 3:6], **scalars)

    def contact_force(self, contact: Contact | FacetOptions | str) -> np.ndarray:
        """Force (N) and moment about the origin (N m) of a contact on its body over the last accepted step.

        (B, 6) in world axes; over time see `contact_record`. NaN as for `reaction`.
        """
        return self._of_last_step(self.contact_column(contact))

    def contact_column(self, contact: Contact | FacetOptions | str) -> int:
        """First report column of a contact."""
        term, known = self._find_contact(contact)
        return term.contact_column(known)

    def element_size(self, contact: Contact | FacetOptions | str) -> float:
        """Size, m, that `StepReport.penetration` divides the depth of a contact by."""
        term, known = self._find_contact(contact)
        return term.element_size(known)

    def _find_contact(self, contact: Contact | FacetOptions | str) -> tuple[Touching, Any]:
        """Term and handle of a contact."""
        things = self.model.description.contacts_of(ContactOptions)
        known = _find("contact", contact, things, "a handle from add_contact, or a name")
        return next(term for term in self.model.terms.contacts if known in term.tables.contacts), known


def _find(kind: str, given: Any, things: Sequence[Any], handle: str) -> Any:
    """The joint or contact of a model by its handle or name."""
    for thing in things:
        if thing is given or thing.name == given:
            return thing
    names = [thing.name for thing in things]
    raise ModelError(
        f"expected a {kind} of this model ({handle}), got {given!r}; it has: {listing(names)}"
        f"{did_you_mean(given, names) if isinstance(given, str) else ''}"
    )


class PartMember:
    """Descriptor of a member of a part: with `positions = PartMember("results", Results.positions)` an object's
    `positions` is `results.positions`, read and written.

    Args:
        part: name of the part, an attribute of the object.
        member: function or property of the part's class, for its documentation.
    """

    def __init__(self, part: str, member: Any = None) -> None:
        self.part, self.member = part, member

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, whole: Any, owner: type) -> Any:
        return self.member if whole is None else getattr(getattr(whole, self.part), self.name)

    def __set__(self, whole: Any, value: Any) -> None:
        setattr(getattr(whole, self.part), self.name, value)
