"""One point of a study: a run with one setting, its cost and the motion of its probes."""

from __future__ import annotations

import base64
import dataclasses
import time as clock
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...base.errors import CapacityError, ConstraintError, ConvergenceError, Error
from ...base.usercode import convert_user_errors
from ...builder.scene import Scene
from ...model.model import Model
from ...simulation.simulation import Simulation
from ...solvers import SOLVERS
from .settings import Setting

__all__ = ["DONE", "FAILED", "REFUSED", "TOO_LONG", "Outcome", "measure"]

DONE, FAILED, TOO_LONG, REFUSED = "done", "failed", "too long", "refused"
MAX_REPEATED_SECONDS = 2.0
"""s; a run that takes longer is done once."""
STORED_ENERGIES = ("kinetic", "strain", "contact", "contact_pairs")
EXCHANGED_ENERGIES = ("potential", "work", "viscous", "contact_loss", "friction", "collider_work")
"""Columns of the energy ledger that define the energy exchanged: their size, or their change."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """Outcome of a run.

    Attributes:
        status: done; failed: a step was not accepted; too long; refused: invalid setting for this scene.
        why: reason of all others than done.
        cost: see `_Run.cost`; empty if nothing was run.
        times: (n,), s. probes: by name position and velocity (n, 3) each, m and m/s. start_positions: by name (3,), m.
        field: value of the scene's `field`, or None.
    """

    status: str
    why: str = ""
    cost: dict[str, Any] = dataclasses.field(default_factory=dict)
    times: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))
    probes: dict[str, tuple[np.ndarray, np.ndarray]] = dataclasses.field(default_factory=dict)
    start_positions: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    field: np.ndarray | None = None

    def to_dict(self) -> dict[str, Any]:
        """JSON-compatible form, with all digits."""
        return {
            "status": self.status, "why": self.why, "numbers": self.cost, "times": _encode_array(self.times),
            "probes": {name: [_encode_array(x), _encode_array(v)] for name, (x, v) in self.probes.items()},
            "starts": {name: _encode_array(x) for name, x in self.start_positions.items()},
            "field": None if self.field is None else _encode_array(self.field),
        }  # fmt: skip

    @staticmethod
    def from_dict(data: dict[str, Any]) -> Outcome:
        """Outcome from the output of `to_dict`."""
        return Outcome(
            data["status"], data["why"], data["numbers"], _decode_array(data["times"]),
            {name: (_decode_array(x), _decode_array(v)) for name, (x, v) in data["probes"].items()},
            {name: _decode_array(x) for name, x in data["starts"].items()},
            None if data["field"] is None else _decode_array(data["field"]),
        )  # fmt: skip


def _encode_array(values: np.ndarray) -> list[Any]:
    return [list(values.shape), base64.b64encode(zlib.compress(np.ascontiguousarray(values, float).tobytes())).decode()]


def _decode_array(data: list[Any]) -> np.ndarray:
    shape, text = data
    return np.frombuffer(zlib.decompress(base64.b64decode(text)), float).reshape(shape).copy()


def measure(scene: Scene[Any], setting: Setting, *, repeat: int, limit: float | None) -> Outcome:
    """Run a setting `repeat` times; results of the first run, times of all.

    Only steps are timed; construction of model and simulation (kernel compilation) is measured separately. Runs
    longer than `limit` seconds are given up.

    Raises:
        KeyboardInterrupt: after Ctrl-C, once the step in hand is done.
    """
    began = clock.perf_counter()
    try:
        model = scene.build(setting.values).finalize(device=setting.device, dtype=setting.dtype)
        setup = clock.perf_counter() - began
        runs = [_Run(model, setting, limit)]
        while len(runs) < repeat and runs[-1].seconds <= MAX_REPEATED_SECONDS:
            runs.append(_Run(model, setting, limit))
    except (ConvergenceError, ConstraintError, CapacityError) as error:  # before the first step
        return Outcome(FAILED, _one_line(error))
    except (Error, NotImplementedError) as error:
        return Outcome(REFUSED, _one_line(error))
    first = runs[0]
    cost = first.cost() | {"setup_s": setup, "seconds": [run.seconds for run in runs]}
    cost |= {"asked": repeat, "limit": limit}
    if first.status != DONE:
        return Outcome(first.status, first.why, cost)
    probes = {p.name: first.sim.probe(p.name) for p in model.description.probes}
    times = next(iter(probes.values())).time
    values = None
    if scene.field is not None:
        with convert_user_errors(f"field of scene {scene.name!r}"):
            values = np.asarray(scene.field(first.sim), dtype=float)
    motions = {name: (record.position[0], record.velocity[0]) for name, record in probes.items()}
    u = model.state().displacement.numpy()[0].astype(float)
    start_positions = {p.name: np.asarray(p.X + p.weights @ u[p.slots], dtype=float) for p in model.description.probes}
    return Outcome(DONE, "", cost, np.ravel(times), motions, start_positions, values)


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())


class _Run:
    """Timed run of a simulation to its end."""

    def __init__(self, model: Model, setting: Setting, limit: float | None) -> None:
        self.status, self.why, self.seconds = DONE, "", 0.0
        steps: dict[str, Any] = {"dt": setting.dt}
        if setting.error is not None:
            steps = {"dt": "auto", "error": setting.error}
        solver = SOLVERS[setting.solver](tol=setting.tol)
        self.sim = Simulation(model, solver=solver, integrator=setting.method, **steps)
        self.energies = [self.sim.energies()]
        self.limit = limit
        self.step_began = clock.perf_counter()
        try:
            self.sim.run(setting.t_end, on_step=self._after_step, progress=False)
        except (ConvergenceError, ConstraintError) as error:
            self.seconds += clock.perf_counter() - self.step_began
            self.status, self.why = FAILED, _one_line(error)

    def _after_step(self, sim: Simulation) -> bool:
        self.seconds += clock.perf_counter() - self.step_began
        self.energies.append(sim.energies())
        if self.limit is not None and self.seconds > self.limit:
            self.status, self.why = TOO_LONG, f"more than {self.limit:g} s"
            return False
        self.step_began = clock.perf_counter()
        return True

    def cost(self) -> dict[str, Any]:
        """Cost and losses of the run: counts over all steps, bytes on the device, energies in J.

        drift: largest |change of energy + losses of the model - work|: error of the scheme and the solver;
        exchanged: largest energy of one kind (kinetic, strain), or its change; ledger:
        change of each term of the energy ledger over the run.
        """
        sim, info = self.sim, self.sim.model.info()
        table = {name: np.array([float(e[name][0]) for e in self.energies]) for name in self.energies[0]}
        sizes = [np.abs(table[name]).max() for name in STORED_ENERGIES]
        sizes += [np.abs(table[name] - table[name][0]).max() for name in EXCHANGED_ENERGIES]
        drift = np.abs(table["ledger_residual"] - table["integrator"])
        return {
            "time": float(sim.time[0]),
            "steps": int(sim.totals["substeps"][0]) if "substeps" in sim.totals else sim.steps,
            "newton": int(sim.totals["newton"][0]),
            "pcg": int(sim.totals["pcg"][0]),
            "rough": int(sim.totals["rough"][0]),
            "bytes": sum(sim.bytes().values()),
            "unknowns": int(info["unknowns"]),
            "elements": int(info["elements"]),
            "drift": float(drift.max()),
            "exchanged": float(max(sizes)),
            "ledger": {name: float(values[-1] - values[0]) for name, values in table.items()},
            "compile_s": sim.compile_s,
        }
