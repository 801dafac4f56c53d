"""Summary of a run: JSON with fixed keys, and a readable table."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..base.console import format_number, format_table, to_json
from ..base.provenance import versions
from ..kernels.elements.materials import DEFINED_FOR_ANY_J
from ..kernels.step.step_control import SAME_TIME_FRACTION
from ..model.model import Model
from ..simulation.energy_growth import integrator_energy_ratio
from ..simulation.overlap import Crossing
from ..simulation.simulation import Simulation
from ..solvers import Jacobi
from .source import Source

__all__ = ["SCHEMA", "SUMMARY_KEYS", "box_text", "mass_text", "model_box", "summarize", "summary_text"]

SCHEMA = 1
SUMMARY_KEYS = (
    "schema", "scene", "analysis", "parameters", "device", "dtype", "dt", "t_end", "load", "steps", "substeps",
    "status", "wall_s", "compile_s", "setup_s", "solve_s", "output_s", "newton_iterations", "pcg_iterations",
    "max_residual", "min_J", "rough_steps", "floored_steps", "max_floor", "mass", "bounding_box", "energies", "probes",
    "violation", "versions", "left_out", "contacts", "stable", "overlaps",
)  # fmt: skip
MAX_ROWS = 12
"""Maximum number of joints and contacts listed one by one."""
SHOWN_ROWS = 4
"""Number of joints and contacts listed of more."""
INTEGRATOR_SHARE = 0.05
"""Numerical dissipation over the energy exchanged above which the summary suggests another scheme."""
LESS_DISSIPATION = {
    "backward_euler": "--integrator bdf2 takes far less of slow motion, energy_momentum nothing; a smaller --dt less",
    "bdf2": "--integrator energy_momentum takes nothing, a smaller --dt less",
    "generalized_alpha": "--integrator energy_momentum takes nothing, a larger rho_inf or a smaller --dt less",
    "energy_momentum": "contact takes it at the end of steps; a smaller --dt takes less",
}
"""Suggestion for large numerical dissipation."""
ADDED_ENERGY = "--integrator bdf2 or 'energy_momentum(rho_inf=0.8)', or a smaller --dt"
"""Suggestion after a warning that generalized-alpha adds energy."""
MAX_PENETRATION = 0.01
"""Depth of a contact over the size of its smallest element above which the summary warns."""
NO_MIN_J = 1e30
"""Reported min J without elements that have one."""


def summarize(
    source: Source, sim: Simulation, *, status: str, wall_s: float, setup_s: float | None = None
) -> dict[str, Any]:
    """Summary of a run of one world, SI units.

    `analysis` is "dynamic" or "static"; `t_end` the time reached, in statics `load` the load factor, 0 to 1, with
    `steps` load steps; `substeps` are the accepted ones of dt="auto", whose `steps` are intervals, else null;
    `mass` is null if a density is missing, `bounding_box` that of the reference; `wall_s` are the seconds from
    building to the closing of files: `setup_s` until the first step, of which `compile_s` to make the simulation with
    its kernels, `output_s` to write files, `solve_s` the rest; `min_J` is the smallest det F of any step, null if
    there is none; `rough_steps` are those accepted short of the tolerance (Jacobi), `floored_steps` those whose
    residual rounding stopped above it, and `max_floor` the largest error that was estimated there
    (`StepReport.floor`),
    0 without such steps; energies and probes are the last values, of statics the strain energy alone; `violation` is
    the largest of the constraints in any step, m; `contacts` has by name the largest normal_force, N, penetration, m,
    and relative_penetration (over the size of its smallest element) of any step, and the last force, N, area, m^2, and
    stick; `stable` is the stability of the static equilibrium, null if unknown; `overlaps` are pairs of bodies, or of a
    body and a collider, that cross without a contact, with the time, s or load factor, and the depth, m, of the check
    that found them.
    """
    setup_s = min(sim.compile_s if setup_s is None else setup_s, wall_s)
    output_s = min(sim.output_s, wall_s - setup_s)
    probes = {}
    for probe in sim.model.description.probes:
        record = sim.probe(probe.name)
        names = ("position", "displacement", "velocity")
        if record.time.size:
            probes[probe.name] = {name: getattr(record, name)[0, -1] for name in names}
    static = sim.load is not None
    if static:
        energies = {"strain": sim.model.strain_energy(sim.state)}
    else:
        energies = sim.energies()
    content = {
        "schema": SCHEMA, "scene": source.label, "analysis": "static" if static else "dynamic",
        "parameters": source.parameters, "device": str(sim.model.device), "dtype": sim.model.dtype,
        "dt": None if static else sim.dt if sim.error is None else "auto",
        "t_end": None if static else float(sim.time.max()), "load": None if sim.load is None else float(sim.load.max()),
        "steps": sim.steps, "substeps": int(sim.totals["substeps"].sum()) if "substeps" in sim.totals else None,
        "status": status, "wall_s": wall_s, "compile_s": min(sim.compile_s, setup_s), "setup_s": setup_s,
        "solve_s": wall_s - setup_s - output_s, "output_s": output_s,
        "newton_iterations": int(sim.totals["newton"].sum()), "pcg_iterations": int(sim.totals["pcg"].sum()),
        "max_residual": sim.max_residual, "min_J": sim.min_J if sim.min_J < NO_MIN_J else None,
        "rough_steps": int(sim.totals["rough"].sum()), "floored_steps": int(sim.totals["floored"].sum()),
        "max_floor": sim.max_floor, "mass": sim.model.mass, "bounding_box": model_box(sim.model),
        "energies": {name: float(values[0]) for name, values in energies.items()}, "probes": probes,
        "violation": sim.max_violation, "versions": versions(), "left_out": sim.model.info()["left_out"],
        "contacts": _contact_values(sim),
        "stable": None if sim.last is None or sim.last.stable is None else sim.last.stable[0],
        "overlaps": [{name: getattr(crossing, name) for name in ("first", "second", "time", "depth")}
                     for crossing in _crossings(sim)],
    }  # fmt: skip
    assert tuple(content) == SUMMARY_KEYS
    return {name: to_json(value) for name, value in content.items()}


def summary_text(summary: dict[str, Any], sim: Simulation, wrote: Sequence[str]) -> str:
    """The summary as a table."""
    s, info = summary, sim.model.info()
    steps = max(s["steps"], 1)
    done = (
        f"{s['status']}, static, at {format_number(100.0 * (s['load'] or 0.0))} % of the load, {s['steps']} load steps"
    )
    if s["load"] is None:
        done = f"{s['status']} at t = {format_number(s['t_end'], 6)} s, {_steps(s, sim)}"
    rows = [
        ["scene", s["scene"] + "".join(f"  {k}={v}" for k, v in _parameter_pairs(s["parameters"]))],
        ["model", f"{info['elements']} elements, {info['unknowns']} unknowns"],
        ["size", f"{box_text(s['bounding_box'])}, {mass_text(s['mass'])}"],
        ["device", f"{s['device']}, {s['dtype']}, {sim.integrator.label}"],
        ["status", done],
        ["time", _times(s)],
        ["iterations", _iterations(s, sim)],
    ]
    if s["floored_steps"]:
        end = f"{s['floored_steps']} of {s['steps']} steps end where rounding stops the residual"
        rows.append(["", f"{end}; largest estimated error {_number_text(s['max_floor'], 2)}"])
    if s["min_J"] is not None and s["min_J"] <= 0.0:
        rows.append(["WARNING", _inversion_text(s["min_J"], sim.model)])
    if s["stable"] is not None:
        rows.append(["", "the equilibrium is stable"] if s["stable"] else ["UNSTABLE", "the equilibrium is unstable"])
    if s["rough_steps"]:
        reached = s["steps"] - s["rough_steps"]
        tol = format_number(sim.solver.tolerance(s["dtype"]))
        rows.append(
            ["NOT CONVERGED", f"tolerance {tol} reached in {reached} of {s['steps']} steps ({reached / steps:.0%})"]
        )
    e = s["energies"]
    parts = [
        f"{name} {_number_text(e[name])}" for name in ("kinetic", "strain", "potential", "work", "viscous") if name in e
    ]
    rows.append(["energy", f"{', '.join(parts)} J"])
    if s["load"] is None:
        lost, left = _number_text(e["integrator"]), _number_text(e["ledger_residual"], 2)
        rows.append(["", f"numerical dissipation {lost} J, energy imbalance {left} J"])
        rows += _suggestion(sim)
        if s["contacts"]:
            stored = _number_text((e["contact"] or 0.0) + (e["contact_pairs"] or 0.0))
            lost = f"dissipated: impact {_number_text(e['contact_loss'])}, friction {_number_text(e['friction'])} J"
            moved = (
                f", done by colliders {_number_text(e['collider_work'])} J" if sim.model.description.colliders else ""
            )
            rows.append(["", f"in contact {stored} J, {lost}{moved}"])
    for name, values in s["probes"].items():
        u = ", ".join(_number_text(x) for x in values["displacement"])
        rows.append([f"probe {name}", f"displaced by ({u}) m"])
    rows += _joint_rows(sim)
    rows += [["WARNING", crossing.text] for crossing in _crossings(sim)[:SHOWN_ROWS]]
    rows += _contact_rows(s["contacts"]) + _penetration_rows(s["contacts"], static=s["load"] is not None)
    rows += [["wrote" if k == 0 else "", text] for k, text in enumerate(wrote)]
    return format_table(rows)


def _times(s: dict[str, Any]) -> str:
    """Seconds of the run and its parts."""
    setup, kernels, solve, output = (f"{s[f'{name}_s']:.1f} s" for name in ("setup", "compile", "solve", "output"))
    return f"{s['wall_s']:.1f} s: set-up {setup} (kernels {kernels}), solve {solve}, output {output}"


def _suggestion(sim: Simulation) -> list[list[str]]:
    """A row suggesting other schemes if the integrator dissipates or adds much of the energy exchanged."""
    share, name = integrator_energy_ratio(sim), sim.integrator.name
    if not share > INTEGRATOR_SHARE:
        return []
    text = ADDED_ENERGY if name == "generalized_alpha" and sim.energy_growth.warned else LESS_DISSIPATION[name]
    return [["", f"that is {share:.0%} of the energy turned over: {text}"]]


def _steps(s: dict[str, Any], sim: Simulation) -> str:
    """Numbers of steps by size."""
    if sim.error is None:
        end = s["steps"] * s["dt"] - s["t_end"]
        shorter = s["status"] == "done" and SAME_TIME_FRACTION * s["dt"] < end < s["dt"]
        return f"{s['steps']} steps of {format_number(s['dt'])} s{', the last shorter' * shorter}"
    refused = int(sim.totals["rejected"].sum())
    substeps, error = int(sim.totals["substeps"].sum()), format_number(sim.error)
    return f"{substeps} adaptive steps, {refused} refused, for an error of {error}"


def model_box(model: Model) -> list[list[float]]:
    """Lowest and highest corner of the reference of all bodies, m."""
    boxes = np.array([body.mesh.bounding_box() for body in model.bodies])
    return [boxes[:, 0].min(axis=0).tolist(), boxes[:, 1].max(axis=0).tolist()]


def box_text(box: Sequence[Sequence[float]]) -> str:
    """Readable sides of a box."""
    return " x ".join(format_number(high - low) for low, high in zip(*box)) + " m"


def mass_text(mass: float | None) -> str:
    """Readable mass."""
    return "no density" if mass is None else f"{format_number(mass)} kg"


def _inversion_text(J: float, model: Model) -> str:
    """Text of J <= 0: laws that need J > 0 forbid it at the quadrature points, not at the vertices."""
    if any(block.key.law in DEFINED_FOR_ANY_J for block in model.blocks):
        advice = "take a finer mesh, smaller loads or a law that forbids it (neo_hookean)"
        return f"an element turned inside out: J = {format_number(J, 3)}; {advice}"
    return f"J = {format_number(J, 3)} at a vertex of an element: take a finer mesh or smaller loads"


def _iterations(s: dict[str, Any], sim: Simulation) -> str:
    """Iterations and residuals."""
    if s["steps"] == 0:
        return "no step was accepted"
    steps = max(s["steps"] if s["substeps"] is None else s["substeps"], 1)  # accepted ones of adaptive steps
    first, second = s["newton_iterations"] / steps, s["pcg_iterations"] / steps
    counts = f"{first:.1f} of Jacobi" if isinstance(sim.solver, Jacobi) else f"{first:.1f} Newton and {second:.0f} PCG"
    text = f"{counts} per step, residual up to {_number_text(s['max_residual'], 2)}"
    return text + (f", violation up to {_number_text(s['violation'], 2)} m" if sim.model.constraints else "")


def _joint_rows(sim: Simulation) -> list[list[str]]:
    """A row for each joint at the end; of many the most violated ones and a count."""
    joints = sim.model.constraints.joints if sim.model.constraints else []
    violation = np.array([sim.violation(joint)[0] for joint in joints])
    shown = range(len(joints)) if len(joints) <= MAX_ROWS else np.argsort(-violation, kind="stable")[:SHOWN_ROWS]
    rows = []
    for k in shown:
        text = f"{joints[k].kind}, violation {_number_text(violation[k], 2)} m"
        record = sim.joint_record(joints[k])
        if record.time.size:
            force, moment = (float(np.linalg.norm(values[0, -1])) for values in (record.force, record.moment))
            text += f", force {_number_text(force)} N, moment {_number_text(moment)} N m"
        rows.append([f"joint {joints[k].name}", text])
    if len(rows) < len(joints):
        rows.append(["joints", f"{len(joints)} joints; largest violations shown"])
    return rows


def _contact_values(sim: Simulation) -> dict[str, Any]:
    """Maximum and last values of each recorded contact."""
    out = {}
    for contact in sim.model.description.contacts:
        record = sim.contact_record(contact)
        if record.time.size:
            largest = {name: np.nanmax(getattr(record, name)[0]) for name in ("normal_force", "penetration")}
            size = sim.records.element_size(contact) if largest["penetration"] > 0.0 else 1.0
            largest["relative_penetration"] = largest["penetration"] / size
            out[contact.name] = largest | {name: getattr(record, name)[0, -1] for name in ("force", "area", "stick")}
    return out


def _contact_rows(contacts: dict[str, Any]) -> list[list[str]]:
    """A row for each contact; of many those with the largest forces and a count."""
    names = sorted(contacts, key=lambda name: -(contacts[name]["normal_force"] or 0.0))
    shown = contacts if len(contacts) <= MAX_ROWS else names[:SHOWN_ROWS]
    rows = []
    for name in shown:
        c = contacts[name]
        text = f"normal force up to {_number_text(c['normal_force'])} N, "
        text += f"penetration up to {_number_text(c['penetration'])} m"
        rows.append([f"contact {name}", f"{text}, at the end {_number_text(c['area'])} m^2 in contact"])
    if len(rows) < len(contacts):
        rows.append(["contacts", f"{len(contacts)} in all, of which these have the largest forces"])
    return rows


def _crossings(sim: Simulation) -> list[Crossing]:
    """Crossings found by the simulation."""
    return sim.overlap_check.found if sim.overlap_check else []


def _penetration_rows(contacts: dict[str, Any], *, static: bool) -> list[list[str]]:
    """A warning for each contact that is deeper than `MAX_PENETRATION`, of many the deepest ones."""
    deep = {name: c["relative_penetration"] or 0.0 for name, c in contacts.items()}
    names = sorted((name for name in deep if deep[name] > MAX_PENETRATION), key=lambda name: -deep[name])
    cure = "take a higher stiffness=" + ("" if static else ", or a smaller dt if it is deep in an impact")
    return [["WARNING", f"contact {name!r}: penetration of up to {deep[name]:.2g} of its smallest element; {cure}"]
            for name in names[:SHOWN_ROWS]]  # fmt: skip


def _number_text(value: float | None, digits: int = 4) -> str:
    return "not finite" if value is None else format_number(value + 0.0, digits)


def _parameter_pairs(parameters: dict[str, Any]) -> list[tuple[str, str]]:
    """Parameters in one line: numbers short, empty ones omitted."""
    out = []
    for name, value in parameters.items():
        if value not in (None, [], ""):
            text = format_number(value, 6) if isinstance(value, float) else str(value)
            out.append((name, text.replace(" ", "")))
    return out
