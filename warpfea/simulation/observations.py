"""Observation table [world, column] on the device."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from ..base.errors import ModelError
from ..base.names import did_you_mean, listing
from ..base.short_repr import truncated_lines
from ..kernels.contact.structs import RECORD_NAMES
from ..kernels.step.episodes import JOINT_VALUE_KINDS, MOTION_KINDS, observation_kernels
from ..terms.joint_values import coordinate_vectors, turn_source, vector_tables

__all__ = ["Observations"]

# first column after that of the joint or contact, and number of columns, by quantity
JOINT_REPORT_COLUMNS = {"force": (0, 3), "moment": (3, 3), "violation": (6, 1)}
CONTACT_REPORT_COLUMNS = {"force": (0, 3), "moment": (3, 3)} | {
    name: (k, 1) for k, name in enumerate(RECORD_NAMES) if k > 5
}
AXES_KINDS = {"axes": "position", "axes_rate": "velocity"}
NAME_FORMS = "'time', 'body.NAME.position', 'probe.NAME.velocity', 'joint.NAME.angle' or 'contact.NAME.force'"


class Observations:
    """Table [world, column] on the device, filled by `update()` from the present state; made by `sim.observe(...)`.

    Each name selects adjacent columns, in the order of the names:

        time                                              1: s
        body.NAME.position, .displacement, .velocity      3 per node of the mesh, in its order: m, m/s
        part.NAME.position, .displacement, .velocity      3: of the centre of mass of a rigid part: m, m/s
        part.NAME.axes, .axes_rate                        9: columns of its rotation A, and dA/dt, 1/s
        probe.NAME.position, .displacement, .velocity     3: m, m/s
        joint.NAME.angle, .travel, .length                1: rad, m; as `sim.joint_value`
        joint.NAME.angle_rate, .travel_rate, ...          1: rad/s, m/s; as `sim.joint_rate`
        joint.NAME.force, .moment, .violation             3, 3, 1: N, N m, m; as `sim.joint_force`
        contact.NAME.force, .moment, .normal_force, ...   3, 3, 1: as `ContactRecord`, over the last step

    Forces are 0 in worlds without a step since construction or reset. Nothing is read back: `update()` launches
    kernels, and `array` keeps its memory, which `wp.to_torch(obs.array)`, `torch.from_dlpack(obs)` and, on the CPU,
    `obs.array.numpy()` share without a copy.

    Attributes:
        array: Warp array [world, column] in the model's precision.
        columns: slice of the columns, by name.
    """

    def __init__(self, sim: Any, names: tuple[str, ...]) -> None:
        self._sim, self._model = sim, sim.model
        if not names:
            raise ModelError(f"observe: name what to observe, such as {NAME_FORMS}")
        self.columns: dict[str, slice] = {}
        self._points: list[tuple[Any, Any, str, Any, int]] = []
        self._values: list[tuple[list[Any], str, int, int]] = []
        self._reports: list[tuple[int, int]] = []
        self._times: list[int] = []
        self._column_count = 0
        for name in names:
            first = self._column_count
            self._add_columns(name)
            self.columns[name] = slice(first, self._column_count)
        self.array: wp.array = wp.zeros((self._model.worlds, self._column_count), dtype=self._model.types.T,
                                        device=self._model.device)  # fmt: skip
        self._kernels = observation_kernels(self._model.dtype)
        self._upload()

    # names

    def _add_columns(self, name: Any) -> None:
        if not isinstance(name, str) or name in self.columns:
            twice = "is there twice" if isinstance(name, str) else "is no name"
            raise ModelError(f"observe: {name!r} {twice}")
        if name == "time":
            self._times.append(self._column_count)
            self._column_count += 1
            return
        kind, _, rest = name.partition(".")
        owner, _, what = rest.rpartition(".")
        makers = {
            "body": self._add_body,
            "part": self._add_part,
            "probe": self._add_probe,
            "joint": self._add_joint,
            "contact": self._add_contact,
        }
        if kind not in makers or not owner:
            raise ModelError(f"observe: {name!r} is unknown{did_you_mean(kind, list(makers))}; names are {NAME_FORMS}")
        makers[kind](name, owner, what)

    def _check_quantity(self, name: str, what: str, known: Any) -> None:
        if what not in known:
            hint = did_you_mean(what, list(known))
            raise ModelError(f"observe: {name!r} is unknown; of {name.rpartition('.')[0]!r} there are: "
                             f"{listing(known)}{hint}")  # fmt: skip

    @staticmethod
    def _find(kind: str, owner: str, things: Sequence[Any]) -> Any:
        known = {thing.name: thing for thing in things}
        if owner not in known:
            hint = did_you_mean(owner, known)
            raise ModelError(f"observe: {kind} {owner!r} is unknown; there are: {listing(known)}{hint}")
        return known[owner]

    def _add_body(self, name: str, owner: str, what: str) -> None:
        body = self._find("body", owner, self._model.bodies)
        self._check_quantity(name, what, MOTION_KINDS)
        for node, X in enumerate(body.mesh.points):
            slots, weights = body.node_functions(node)
            self._points.append((body.slot_offset + slots, weights, what, X, self._column_count))
            self._column_count += 3

    def _add_part(self, name: str, owner: str, what: str) -> None:
        part = self._find("part", owner, [body for body in self._model.bodies if body.rigid])
        self._check_quantity(name, what, [*MOTION_KINDS, *AXES_KINDS])
        rows = [(0, part.com)] if what in MOTION_KINDS else [(k + 1, e) for k, e in enumerate(np.eye(3))]
        for row, X in rows:
            kind = AXES_KINDS.get(what, what)
            self._points.append((part.slots, part.affine[row], kind, X, self._column_count))
            self._column_count += 3

    def _add_probe(self, name: str, owner: str, what: str) -> None:
        probe = self._find("probe", owner, self._model.description.probes)
        self._check_quantity(name, what, MOTION_KINDS)
        self._points.append((probe.body.slot_offset + probe.slots, probe.weights, what, probe.X, self._column_count))
        self._column_count += 3

    def _add_joint(self, name: str, owner: str, what: str) -> None:
        first = self._sim.records.joint_column(owner)
        tables = self._model.constraints
        assert tables is not None
        joint = self._sim.records.find_joint(owner)
        has = coordinate_vectors(joint)
        self._check_quantity(name, what, [*has, *(f"{key}_rate" for key in has), *JOINT_REPORT_COLUMNS])
        coordinate = what.removesuffix("_rate")
        if coordinate in has:
            self._values.append((has[coordinate], what, turn_source(tables, joint), self._column_count))
            self._column_count += 1
            return
        self._add_report(first, JOINT_REPORT_COLUMNS[what])

    def _add_contact(self, name: str, owner: str, what: str) -> None:
        first = self._sim.records.contact_column(owner)
        self._check_quantity(name, what, CONTACT_REPORT_COLUMNS)
        self._add_report(first, CONTACT_REPORT_COLUMNS[what])

    def _add_report(self, first: int, columns: tuple[int, int]) -> None:
        begin, count = columns
        for k in range(count):
            self._reports.append((first + begin + k, self._column_count))
            self._column_count += 1

    # tables

    def _upload(self) -> None:
        m = self._model

        def array(values: Any, dtype: Any) -> wp.array:
            return wp.array(np.asarray(values), dtype=dtype, device=m.device)

        def sums(entries: list[tuple[Any, Any]]) -> list[wp.array]:
            start = np.concatenate([[0], np.cumsum([len(slots) for slots, _ in entries])])
            slot = np.concatenate([*(np.asarray(slots, dtype=float) for slots, _ in entries), np.zeros(1)])
            weight = np.concatenate([*(np.asarray(w, dtype=float) for _, w in entries), np.zeros(1)])
            return [array(start, wp.int32), array(slot, wp.int32), array(weight, wp.float64)]

        points = self._points
        self._motion_tables = [
            *sums([(slots, weights) for slots, weights, *_ in points]),
            array([MOTION_KINDS[p[2]] for p in points], wp.int32),
            array(np.array([p[3] for p in points], dtype=float).reshape(-1, 3), wp.vec3d),
            array([p[4] for p in points], wp.int32),
        ] if points else []  # fmt: skip
        vectors = [v for entry in self._values for v in (entry[0] + [entry[0][0]] * 2)[:3]]
        self._joint_value_tables = [
            *vector_tables(vectors, array),
            array([JOINT_VALUE_KINDS[v[1]] for v in self._values], wp.int32),
            array([v[2] for v in self._values], wp.int32),
            array([v[3] for v in self._values], wp.int32),
        ] if vectors else []  # fmt: skip
        reports = np.array(self._reports, dtype=np.int32).reshape(-1, 2)
        self._report_columns = [array(reports[:, k].copy(), wp.int32) for k in range(2)] if len(reports) else []
        self._stepped_flags: wp.array | None = None
        if self._report_columns:
            own = self._sim.stepper.episodes.stepped_flags
            self._stepped_flags = wp.zeros(m.worlds, dtype=wp.int32, device=m.device) if own is None else own

    # use

    def update(self) -> wp.array:
        """Fill the table from the present state and the last step; returns `array`."""
        sim, k, B = self._sim, self._kernels, self._model.worlds
        state, launch = sim.state, sim.stepper.launch
        if self._motion_tables:
            args = [*self._motion_tables, state.displacement, state.velocity, self.array]
            launch(k.point_motions, (B, len(self._points)), args)
        if self._joint_value_tables:
            turns = [state.constraint_target, getattr(state, "joint_angle", state.constraint_target)]
            args = [*self._joint_value_tables, state.displacement, state.velocity, *turns, self.array]
            launch(k.joint_values, (B, len(self._values)), args)
        if self._report_columns:
            assert self._stepped_flags is not None
            if not sim.asynchronous:  # known on the host
                self._stepped_flags.assign(sim.statistics.stepped_worlds.astype(np.int32))
            args = [*self._report_columns, sim.stepper.work.report, self._stepped_flags, self.array]
            launch(k.report_columns, (B, len(self._reports)), args)
        for column in self._times:
            launch(k.world_values, B, [state.time, column, self.array])
        return self.array

    def __getitem__(self, name: str) -> wp.array:
        """Columns [world, column] of a name, a view of `array`."""
        if name not in self.columns:
            hint = did_you_mean(name, list(self.columns))
            raise ModelError(f"observations have no {name!r}; they have: {listing(self.columns)}{hint}")
        return self.array[:, self.columns[name]]

    def __dlpack__(self, stream: Any = None) -> Any:
        return self.array.__dlpack__(stream)

    def __dlpack_device__(self) -> Any:
        return self.array.__dlpack_device__()

    def __repr__(self) -> str:
        return truncated_lines(f"Observations({', '.join(self.columns)}: {self._model.worlds} x {self._column_count})")
