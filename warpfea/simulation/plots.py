"""Line plots of a run: probes, joints, contacts, energies, iterations; for pages, and as a figure of matplotlib."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.checks import is_count
from ..base.errors import ModelError
from ..base.lazy import require_matplotlib

__all__ = ["energy_plot", "plot_run", "record_plots", "run_warnings"]

Array = npt.NDArray[Any]
PLOTTED = 8
"""Number of probes, joints or contacts plotted of many, the first of each."""
SAMPLES = 240
"""Largest number of intervals of a curve; of each the least and the largest value are kept."""
LEDGER = (
    "kinetic", "strain", "potential", "springs", "contact", "work", "viscous", "spring_loss", "contact_loss",
    "friction", "collider_work", "integrator",
)  # fmt: skip
STEP_LOG = ("time", "newton", "pcg", "halvings")
"""Entries of `RunStatistics.step_log`: the time, s, and the largest count of all worlds of each step."""
XYZ = ("x", "y", "z")
NO_MOMENT = 1e-6
"""A moment below this part of the force times the largest body is round-off of a joint that carries none."""


def record_plots(sim: Any, worlds: Sequence[int]) -> list[dict[str, Any]]:
    """Plots of the records of probes, joints and contacts of some worlds, and of the histories of joints."""
    description, out = sim.model.description, []
    for probe in getattr(description, "probes", ())[:PLOTTED]:
        record = sim.probe(probe.name)
        out.append(_plot(f"probe {probe.name}: displacement", "m", XYZ, record.time, record.displacement, worlds))
    joints = [joint for joint in getattr(description, "joints", ()) if joint.kind != "rigid"]
    for joint in joints[:PLOTTED]:
        joint_record = sim.joint_record(joint)
        out.append(_plot(f"joint {joint.name}: force", "N", XYZ, joint_record.time, joint_record.force, worlds))
        size = max(float(np.ptp(body.mesh.points, axis=0).max()) for body in sim.model.bodies)
        force = float(np.abs(joint_record.force).max(initial=0.0))
        if np.abs(joint_record.moment).max(initial=0.0) > NO_MOMENT * size * force:
            out.append(_plot(f"joint {joint.name}: moment", "N m", XYZ, joint_record.time, joint_record.moment, worlds))
    for history in (h for h in sim.records.histories if h.label):
        values = history.values[:, :, None] if len(history.time) else np.zeros((sim.model.worlds, 0, 1))
        out.append(
            _plot(history.label, history.units, (history.label.rpartition(" ")[2],), history.time, values, worlds)
        )
    for contact in getattr(description, "contacts", ())[:PLOTTED]:
        c = sim.contact_record(contact)
        size = np.linalg.norm(c.force, axis=2)
        forces = np.stack([c.normal_force, size], axis=2)
        out.append(_plot(f"contact {contact.name}: force", "N", ("normal", "total"), c.time, forces, worlds))
        depth = c.penetration[:, :, None]
        out.append(_plot(f"contact {contact.name}: penetration", "m", ("depth",), c.time, depth, worlds))
    return [plot for plot in out if plot["times"] and len(plot["times"][0]) > 1]


def energy_plot(
    times: Sequence[float], rows: Sequence[dict[str, Array]], worlds: Sequence[int]
) -> list[dict[str, Any]]:
    """Plot of the ledger at frames, without entries that stay 0."""
    names = [name for name in LEDGER if name in (rows[0] if rows else ()) and any(row[name].any() for row in rows)]
    if len(rows) < 2 or not names:
        return []
    values = np.stack([np.stack([row[name] for name in names], axis=1) for row in rows], axis=1)
    texts = [name.replace("_", " ") for name in names]
    return [_plot("energy", "J", texts, np.asarray(times), values, worlds)]


def _plot(
    title: str, units: str, names: Sequence[str], time: Array, values: Array, worlds: Sequence[int]
) -> dict[str, Any]:
    """Curves of values (B, steps, curves) over times (steps,) or (B, steps)."""
    of_world = [(time if time.ndim == 1 else time[world], values[world]) for world in worlds]
    chosen = [(t[rows], v[rows]) for t, v, rows in ((t, v, _thinned(v)) for t, v in of_world)]
    return {
        "title": title, "units": units, "names": list(names), "times": [_json_numbers(t) for t, _ in chosen],
        "values": [[_json_numbers(column) for column in v.T] for _, v in chosen],
    }  # fmt: skip


def _thinned(values: Array) -> Array:
    """Rows of values (steps, curves) that keep the extremes of each interval."""
    count = len(values)
    if count <= 2 * SAMPLES:
        return np.arange(count)
    bounds = np.linspace(0, count, SAMPLES + 1).astype(int)
    rows: list[Array] = [bounds[:-1], np.array([count - 1])]
    for column in np.nan_to_num(values).T:
        parts = [column[a:b] for a, b in itertools.pairwise(bounds)]
        rows += [bounds[:-1] + np.array([int(find(part)) for part in parts]) for find in (np.argmin, np.argmax)]
    return np.unique(np.concatenate(rows))


def _json_numbers(values: Array) -> list[float | None]:
    """Numbers of a header, with six digits; None where not finite."""
    return [float(f"{x:.6g}") if np.isfinite(x) else None for x in values.tolist()]


def run_warnings(sim: Any) -> list[str]:
    """Texts of what is wrong with a run."""
    check, last = getattr(sim, "overlap_check", None), getattr(sim, "last", None)
    out = [crossing.text for crossing in check.found] if check else []
    rough = int(np.sum(sim.totals["rough"])) if hasattr(sim, "totals") else 0
    if rough:
        out.append(f"the tolerance was not reached in {rough} of {sim.steps} steps")
    failed = [] if last is None else np.flatnonzero(np.asarray(last.status) == 1).tolist()
    if failed:
        out.append(f"stopped: a step was refused in world {', '.join(map(str, failed[:8]))}")
    if last is not None and getattr(last, "stable", None) is not None and any(s is False for s in last.stable):
        out.append("the equilibrium is unstable")
    return out


def plot_run(sim: Any, world: int = 0) -> Any:
    """Figure of matplotlib: records of a world over time, its energies now, iterations of each step.

    ModelError: no such world, or no step was taken. OutputError without matplotlib.
    """
    if not (is_count(world) and 0 <= world < sim.model.worlds):
        raise ModelError(f"plot: world = {world!r} must lie between 0 and {sim.model.worlds - 1}")
    log = np.array(sim.statistics.step_log, dtype=float).reshape(-1, len(STEP_LOG))
    if not len(log):
        raise ModelError("plot: no step was taken yet, or steps were not recorded (record=False)")
    plots = record_plots(sim, [world])
    ledger = {} if sim.load is not None or not sim.stepper.ledger else sim.energies()
    energies = {name: float(ledger[name][world]) for name in LEDGER if name in ledger and ledger[name][world] != 0.0}
    count = len(plots) + bool(energies) + 1
    figure = require_matplotlib()(figsize=(9.6, 2.6 * -(-count // 2)), layout="constrained")
    axes = iter(figure.subplots(-(-count // 2), 2, squeeze=False).ravel())
    when = "time, s" if sim.load is None else "load factor"
    for plot, axis in zip(plots, axes):
        for name, values in zip(plot["names"], plot["values"][0]):
            axis.plot(plot["times"][0], np.array(values, dtype=float), label=name)
        axis.set(title=plot["title"], xlabel=when, ylabel=plot["units"])
        axis.legend(fontsize="small")
    if energies:
        axis = next(axes)
        axis.barh([name.replace("_", " ") for name in energies], list(energies.values()), color="0.5")
        axis.set(title="energies now", xlabel="J")
    axis = next(axes)
    for name, column in zip(STEP_LOG[1:], log.T[1:]):
        if column.any():
            axis.step(log[:, 0], column, where="pre", label=name)
    axis.set(title="iterations of each step, most of all worlds", xlabel=when)
    axis.set_yscale("symlog", linthresh=1.0)
    most = log[:, 1:].max()
    ticks = [k * 10**n for n in range(9) for k in (1, 2, 5) if k * 10**n <= most]
    axis.set_yticks([0, *ticks], labels=[f"{tick:g}" for tick in (0, *ticks)])
    axis.legend(fontsize="small")
    for axis in axes:
        axis.remove()
    return figure
