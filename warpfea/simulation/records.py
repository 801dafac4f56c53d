"""Time histories of probes, joints and contacts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import ModelError
from ..base.names import did_you_mean, listing
from ..kernels.contact.structs import RECORD_NAMES
from ..kernels.step.step_control import REPORT_COLUMNS
from ..kernels.terms.constraints import JOINT_COLUMNS
from ..model.contacts import Contact
from ..model.handles import NodeSet
from ..model.joints import Joint
from ..model.pairs import PairContact
from .reports import ContactRecord, JointRecord, ProbeRecord
from .results import Results

if TYPE_CHECKING:
    from .run_statistics import RunStatistics
    from .stepper import Stepper

__all__ = ["Records"]


class Records:
    """Results of the last step and over time: energies, reactions, probes, joints and contacts."""

    def __init__(self, results: Results, stepper: Stepper, statistics: RunStatistics) -> None:
        self.results, self.stepper, self.statistics = results, stepper, statistics
        self.model, self.state = results.model, results.state

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
        if not isinstance(nodes, NodeSet):
            raise ModelError(f"reaction: expected nodes (body.nodes), got {nodes!r}")
        self.results.check_body(nodes.body, "reaction")
        g = self.stepper.work.g.numpy() * (1.0 - self.model.slot_table.free)
        first = nodes.body.node_slot[nodes.indices]
        rows = nodes.body.slot_offset + first[first >= 0]
        total = g[:, rows].sum(axis=1).astype(float)
        total[~self.statistics.stepped_worlds] = np.nan
        return total

    def probe(self, name: str) -> ProbeRecord:
        """Record of the probe `name`, one entry per step. Raises ModelError listing the probes."""
        names = [p.name for p in self.model.description.probes]
        if name not in names:
            raise ModelError(f"probe {name!r} is unknown; there are: {listing(names)}{did_you_mean(name, names)}")
        k = names.index(name)
        table = self._recorded_table([0, *range(1 + 6 * k, 7 + 6 * k)])
        d, v = table[:, :, 1:4], table[:, :, 4:7]
        return ProbeRecord(self._recorded_times(table), self.model.description.probes[k].X + d, d, v)

    def _recorded_table(self, columns: list[int]) -> np.ndarray:
        """Recorded table (B, steps, columns): time, then the columns of the report from the probes on."""
        if self.statistics.history:
            return np.stack([rows[:, columns] for rows in self.statistics.history], axis=1)
        return np.zeros((self.model.worlds, 0, len(columns)))

    def _recorded_times(self, table: np.ndarray) -> np.ndarray:
        """Recorded times (steps,), s, or (B, steps) with times per world."""
        return table[:, :, 0] if self.statistics.times_differ else table[:, :, 0].max(axis=0)

    def _of_last_step(self, first: int) -> np.ndarray:
        """(B, 6) report columns of the last accepted step; NaN for worlds without."""
        out = self.stepper.work.report.numpy()[:, first : first + 6].copy()
        out[~self.statistics.stepped_worlds] = np.nan
        return out

    def joint_record(self, joint: Joint | str) -> JointRecord:
        """Record of a joint (handle or name), one entry per step."""
        first = 1 + self.joint_column(joint) - len(REPORT_COLUMNS)
        columns = [0, *range(first, first + JOINT_COLUMNS)]
        table = self._recorded_table(columns)
        return JointRecord(self._recorded_times(table), table[:, :, 1:4], table[:, :, 4:7], table[:, :, 7])

    def joint_force(self, joint: Joint | str) -> np.ndarray:
        """Force (N) and moment about the anchor (N m) that a joint exerts on its child at the last accepted step.

        (B, 6) in world axes; over time see `joint_record`. NaN as for `reaction`.
        """
        return self._of_last_step(self.joint_column(joint))

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

        (B,), in the present state; a driven angle counts full turns, others lie between -pi and pi. `what`: "angle",
        "travel" or "length" if a joint has several. Travel is along the parent's axis, per unit of its reference.
        """
        known = self.find_joint(joint)
        constraints = self.model.constraints
        assert constraints is not None
        return constraints.measure(known, what, self.state)

    def joint_column(self, joint: Joint | str) -> int:
        """First report column of a joint."""
        known = self.find_joint(joint)
        return self.model.terms.constraints.report_offset + JOINT_COLUMNS * known.index

    def find_joint(self, joint: Joint | str) -> Joint:
        """Joint of this model by handle or name."""
        joints = self.model.constraints.joints if self.model.constraints else []
        return _find("joint", joint, joints, "a handle from add_joint, add_constraint or weld, or a name")

    def contact_record(self, contact: Contact | PairContact | str) -> ContactRecord:
        """Record of a contact (handle or name), one entry per step."""
        first = 1 + self.contact_column(contact) - len(REPORT_COLUMNS)
        table = self._recorded_table([0, *range(first, first + len(RECORD_NAMES))])
        names = ("normal_force", "penetration", "slip", "area", "stick", "stored", "loss", "friction", "collider_work")
        scalars = {name: table[:, :, 1 + RECORD_NAMES.index(name)] for name in names}
        return ContactRecord(self._recorded_times(table), table[:, :, 1:4], table[:, :, 4:7], **scalars)

    def contact_force(self, contact: Contact | PairContact | str) -> np.ndarray:
        """Force (N) and moment about the origin (N m) of a contact on its body over the last accepted step.

        (B, 6) in world axes; over time see `contact_record`. NaN as for `reaction`.
        """
        return self._of_last_step(self.contact_column(contact))

    def contact_column(self, contact: Contact | PairContact | str) -> int:
        """First report column of a contact."""
        known = _find("contact", contact, self.model.description.contacts, "a handle from add_contact, or a name")
        term = next(term for term in self.model.terms.contacts if known in term.tables.contacts)
        return term.contact_column(known)


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
