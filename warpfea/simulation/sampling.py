"""Fields at material points, and their history over the steps."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp

from ..base.errors import ModelError
from ..model.handles import MaterialPoint, NodeSet
from ..terms.fields import VECTOR, field_at_nodes, field_at_points, find_field
from ..terms.term import FieldSpec

if TYPE_CHECKING:
    from ..model.model import Model
    from ..model.state import State
    from .reports import RunStatistics
    from .stepper import Stepper

__all__ = ["RECORDED_FIELDS", "History", "Sampler", "accelerations", "joint_history", "sampler", "step_loads"]

RECORDED_FIELDS = {
    "acceleration": FieldSpec("acceleration", "m/s2", components=VECTOR),
    "reaction": FieldSpec("reaction", "N", components=VECTOR),
}
"""Fields at nodes that need the last step of a simulation."""


def accelerations(stepper: Stepper) -> np.ndarray:
    """Accelerations (worlds, slots, 3) of the last step, m/s^2."""
    w, state = stepper.work, stepper.state
    if "acceleration" in state.names:
        return np.asarray(state.acceleration.numpy())
    # of the inertia term m M (v - v~)
    return np.asarray(w.step.mass_factor.numpy()[:, None, None] * (w.v.numpy() - w.v_tilde.numpy()))


def step_loads(reference: weakref.ref[Stepper], statistics: RunStatistics) -> Any:
    """Gravity less acceleration (worlds, slots, 3), m/s^2, values of the time laws (worlds, laws, 3), and slots and
    forces of `TermSet.item_forces`, all of the last step; zero in worlds without one, whose accelerations are unknown.
    None once the stepper is gone."""
    stepper = reference()
    if stepper is None:
        return None
    w, loads = stepper.work, stepper.terms.dead_loads
    gravity = loads.gravity.numpy()
    if loads.gravity_law is None:
        gravity = w.step.load_factor.numpy()[:, None] * gravity
    pull = gravity[:, None] * stepper.model.slot_table.is_position[:, None]
    if not stepper.integrator.static:
        pull = pull - accelerations(stepper)
    flags = statistics.stepped_worlds[:, None, None]
    items = [(conn, np.where(flags[..., None], f, 0.0)) for conn, f in stepper.terms.item_forces(w)]
    return np.where(flags, pull, 0.0), np.where(flags, w.time_law_stage_values.numpy(), 0.0), items


class PointWeights:
    """Points of a body, as a Skin has them.

    Attributes:
        slot_weights, node_weights: sparse (points, slots), (points, mesh nodes x samples).
    """

    def __init__(self, body: Any, points: list[MaterialPoint]) -> None:
        rows = np.repeat(np.arange(len(points)), [len(p.slots) for p in points])
        slots, weights = (np.concatenate([getattr(p, name) for p in points]) for name in ("slots", "weights"))
        self.slot_weights = sp.csr_matrix((weights, (rows, slots)), shape=(len(points), body.slot_count))
        k = body.family.node_samples.shape[1]
        width = len(body.mesh.points) * k
        if body.rigid:  # of one value everywhere
            self.node_weights = sp.csr_matrix((len(points), width))
        elif not body.family.has_gradients:  # nodal values by the shape functions
            self.node_weights = sp.csr_matrix((weights, (rows, body.slot_node[slots])), shape=(len(points), width))
        else:
            columns = [(body.mesh.cells[p.element][:, None] * k + np.arange(k)).ravel() for p in points]
            values = [body.family.sample_weights(p.xi[None])[0] for p in points if p.xi is not None]
            size = len(columns[0])
            index = (np.repeat(np.arange(len(points)), size), np.concatenate(columns))
            self.node_weights = sp.csr_matrix((np.concatenate(values), index), shape=(len(points), width))


class Sampler:
    """Values of a field at material points or nodes.

    Raises:
        ModelError: an unknown field, or points that are none of this model.
    """

    def __init__(self, model: Model, points: Any, name: str) -> None:
        self.model, self.name = model, name
        spec = find_field(model.terms, name)
        self.nodes = points if isinstance(points, NodeSet) else None
        self.count = len(points) if isinstance(points, (list, tuple, NodeSet)) else 1
        given = [points] if isinstance(points, MaterialPoint) else points
        known = given if isinstance(given, (list, tuple)) else []
        if self.nodes is None and not (known and all(isinstance(p, MaterialPoint) for p in known)):
            raise ModelError(f"expected material points (body.at, body.line) or nodes (body.nodes), got {points!r}")
        for body in [self.nodes.body] if self.nodes is not None else [p.body for p in known]:
            if body not in model.bodies:
                raise ModelError(f"a point of body {body.name!r}, which is not of this model")
            if body.rigid and self.nodes is None and not (spec.quantities or spec.of_slots or spec.cell_type):
                raise ModelError(f"field {name!r} of rigid part {body.name!r} is one of its nodes: take body.nodes")
        self.groups = []
        for body in {id(p.body): p.body for p in known}.values():
            own = [k for k, p in enumerate(known) if p.body is body]
            self.groups.append((body, np.array(own), PointWeights(body, [known[k] for k in own])))

    def values(self, state: State) -> np.ndarray:
        """Values (worlds, points), or (worlds, points, k)."""
        terms = self.model.terms
        if self.nodes is not None:
            return field_at_nodes(terms, self.name, self.nodes.body, state)[:, self.nodes.indices]
        found = [(own, field_at_points(terms, self.name, body, state, at)) for body, own, at in self.groups]
        out = np.zeros((self.model.worlds, self.count, *found[0][1].shape[2:]))
        for own, values in found:
            out[:, own] = values
        return out


def sampler(results: Any, points: Any, name: str) -> Callable[[], np.ndarray]:
    """Function of nothing that takes a field at points. ModelError as Sampler, or for points where nodes are needed."""
    if results.records and isinstance(name, str) and name.partition(".")[0] in RECORDED_FIELDS:
        find_field(results, name)
        if not isinstance(points, NodeSet):
            raise ModelError(f"field {name!r} is one of nodes: take body.nodes, not {points!r}")
        return lambda: np.asarray(results.field(name, points.body)[:, points.indices])
    of_points = Sampler(results.model, points, name)
    return lambda: of_points.values(results.state)


class History:
    """Record of a field at points, of a reaction, or of a joint, after each step since it was made.

    Attributes:
        label, units: of what is plotted; empty for fields and reactions.
        time: (steps,) s, of the most advanced world.
        values: (worlds, steps, points) or (worlds, steps, points, k); of a reaction (worlds, steps, 6), of a joint
            (worlds, steps).
    """

    def __init__(self, take: Any, label: str = "", units: str = "") -> None:
        self.label, self.units = label, units
        self._take, self._time, self._values = take, list[float](), list[np.ndarray]()

    @property
    def time(self) -> np.ndarray:
        """(steps,) s."""
        return np.array(self._time)

    @property
    def values(self) -> np.ndarray:
        """Values, worlds first, then steps."""
        return np.stack(self._values, axis=1) if self._values else np.zeros((0, 0))

    def __repr__(self) -> str:
        return f"History({len(self._time)} steps)"

    def record(self, sim: Any) -> None:
        """Add the present values."""
        self._time.append(float(np.max(sim.time)))
        self._values.append(self._take())


def joint_history(records: Any, name: str, joint: Any) -> History:
    """History of the "angle", "travel" or "length" of a joint. ModelError for one that has none."""
    records.joint_value(joint, name)
    label = f"joint {records.find_joint(joint).name}: {name}"
    return History(lambda: records.joint_value(joint, name), label, "rad" if name == "angle" else "m")
