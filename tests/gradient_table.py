"""Derivatives by `wf.Adjoint` beside four-point differences, every pair of elements, laws, schemes, parameters and
lengths of runs at once; remainders of Taylor's formula in scenes; growth over a long run.

Run as `python tests/gradient_table.py --out FILE`; `--rows 0:5` makes some rows alone.
"""

import argparse
import json
import pathlib
import sys

import numpy as np
from gradient_models import POINTS, TARGET, WEIGHTS

import warpfea as wf
from warpfea.base.provenance import provenance_of
from warpfea.builder.scene import find
from warpfea.studies.stress.build import covering_array

ELEMENTS = ("T4", "T10", "3243", "3443", "H3843", "FN18")
LAWS = {"SVK": wf.SVK.from_E_nu, "NH": wf.NeoHookean.from_E_nu, "MR": wf.MooneyRivlin.from_E_nu}
LAWS["damped"] = LAWS["SVK"]
SCHEMES = ("backward_euler", "bdf2", "energy_momentum", "generalized_alpha")
KINDS = ("constants", "gravity", "force", "follower", "drive", "motor", "initial")
STEPS = (1, 20, 200)
LENGTHS = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4)
GRAVITY = np.array([0.0, 3.0, -9.81])
CONSTANTS = {"E": 1e6, "nu": 0.3, "density": 1100.0, "eta": 30.0}
DRIVE = np.array([1e-3, 5e-4, 1e-3])
SCENES = dict.fromkeys(("double_pendulum", "plate_pendulum", "four_bar", "slider_crank"), "E")
SCENES |= dict.fromkeys(("pendulum", "chain"), "gravity")


def left_out(kind, scheme):
    """Drives with these schemes: a motor with energy_momentum is refused by name, others are in test_gradients.py."""
    return {"drive": scheme == "generalized_alpha", "motor": scheme in SCHEMES[2:]}.get(kind, False)


def cases():
    """Rows of the table: every pair of values, twice, as what a pair leaves open is the first value of an axis.

    BDF2 takes the place of schemes that are left out.
    """
    found = covering_array(KINDS, ELEMENTS, tuple(LAWS), SCHEMES, STEPS)
    found += covering_array(KINDS, ELEMENTS, (*LAWS,)[::-1], SCHEMES[::-1], STEPS[1:2] + STEPS[::2])
    found = [(*case[:3], "bdf2" if left_out(case[0], case[3]) else case[3], case[4]) for case in found]
    return list(dict.fromkeys(found))


def body_of(b, element, law):
    """A bar of one kind of elements, the nodes of its start, and its end."""
    if element == "3243":
        section = wf.Rectangle(0.01, 0.02)
        beam = b.add_beam([(0, 0, 0), (0.1, 0, 0)], elements=2, section=section, normal=(0, 0, 1), material=law,
                          name="body")  # fmt: skip
        return beam, beam.start, beam.end
    if element == "3443":
        shell = b.add_shell(wf.mesh.grid((0.1, 0.05), cells=(2, 1)), thickness=0.01, material=law, name="body")
        return shell, shell.edge("x-"), shell.at((0.1, 0.025, 0.0))
    kind = {"T10": "T10", "H3843": "H3843"}.get(element, "T4")
    mesh = wf.mesh.box((0.1, 0.02, 0.02), cells=(1 if element == "FN18" else 2, 1, 1), element=kind)
    more = {"element": element} if element == "FN18" else {}
    body = b.add_solid(mesh, material=law, name="body", **more)
    return body, body.nodes("x-"), body.at((0.1, 0.01, 0.01))


def model_of(kind, element, law, worlds):
    """A model of one body with what the parameters of a kind act on."""
    b = wf.ModelBuilder(gravity=GRAVITY)
    damping = wf.KelvinVoigt(CONSTANTS["eta"], 20.0, "incremental") if law == "damped" else None
    values = {name: CONSTANTS[name] for name in ("E", "nu", "density")}
    body, start, end = body_of(b, element, LAWS[law](**values, damping=damping))
    if kind == "motor":
        child = start if element in ("3243", "3443") else body.surface("x-")
        drive = wf.Control("motor")
        anchor = (0, 0.0, 0.0) if element == "3243" else (0, 0.01, 0.01)
        b.add_joint("revolute", parent=wf.GROUND, child=child, anchor=anchor, axis=(0, 1, 0), drive=drive)
    elif kind == "drive":
        b.drive(start, displacement=wf.Control("drive", 3), slots="all" if element in ELEMENTS[2:] else "position")
    else:
        b.clamp(start, slots="all")
    if kind == "force":
        b.add_point_load(end, force=wf.Control("force", 3))
    if kind == "follower" and element in ("T4", "T10"):
        b.add_pressure(body.surface("z-"), wf.Control("follower"))
    elif kind == "follower":
        b.add_moment(end, wf.Control("follower", 3))
    b.add_probe("tip", end)
    return b.finalize(device="cpu", worlds=worlds, many=False)


def parameters_of(kind, law, element):
    """Names and numbers of the parameters of a kind."""
    if kind == "constants":
        return {f"body.{name}": value for name, value in CONSTANTS.items() if name != "eta" or law == "damped"}
    follower = 200.0 if element in ("T4", "T10") else 2e-3  # Pa, N m
    controls = {"force": 0.02, "follower": follower, "drive": DRIVE, "motor": 0.1}
    initial = {"initial.displacement": 1e-4, "initial.velocity": 1e-2}
    return initial if kind == "initial" else {kind: controls.get(kind, GRAVITY)}


def differences(values, exact, lengths):
    """Best relative error of the four-point differences of values (worlds - 1,), parameter by parameter."""
    found = (values.reshape(len(exact), len(lengths), 4) @ WEIGHTS) / np.array(lengths)
    return np.abs(found / np.asarray(exact)[:, None] - 1.0).min(axis=1)


def row(kind, element, law, scheme, steps, lengths=LENGTHS):
    """One row: errors of the derivatives along each parameter of the kind."""
    given = parameters_of(kind, law, element)
    shifts = [np.zeros(len(given))]
    shifts += [h * x * unit for unit in np.eye(len(given)) for h in lengths for x in POINTS]
    scale = 1.0 + np.array(shifts)
    m = model_of(kind, element, law, len(scale))
    rng, state = np.random.default_rng(3), m.state()
    start = {}
    for k, (name, value) in enumerate(given.items()):
        if kind == "constants":
            m.set_parameter(name, value * scale[:, k])
        elif kind == "gravity":
            m.set_gravity(value * scale)
        elif kind == "initial":
            start[name] = value * rng.standard_normal((m.slots, 3))
            getattr(state, name.rpartition(".")[2]).assign(scale[:, k, None, None] * start[name])
    solver = wf.NewtonPCG(tol=1e-12)
    sim = wf.Simulation(m, state, dt=2e-3, integrator=scheme, solver=solver, constraint_tol=1e-13)
    tape = wf.Adjoint(sim, list(given))
    controls = dict.fromkeys(set(given) & set(m.terms.time_laws.controls))
    for name in controls:
        size = sim.controls[name].shape[1]
        phase = np.linspace(0.0, 1.0, size, endpoint=False)
        controls[name] = given[name] * np.sin(0.1 * np.arange(1, steps + 1)[:, None] + phase)
    if not controls:
        tape.run(steps)
    for step in range(steps if controls else 0):
        for name, values in controls.items():
            sim.controls[name][:] = values[step] * scale
        tape.run(1)
    loss = wf.loss.sum_of_squares(tape.probe("tip"), np.full((steps, 3), TARGET))
    g = {name: array.numpy()[0] for name, array in tape.backward(loss).items()}
    directions = controls | start
    exact = [np.sum(g[name] * directions.get(name, value)) for name, value in given.items()]
    errors = differences(loss.numpy()[1:], exact, lengths)
    done = {"parameters": kind, "element": element, "law": law, "integrator": scheme, "steps": steps}
    return done | {"errors": dict(zip(given, errors.tolist())), "residual": float(tape.residual.max()),
                   "growth": float(tape.growth[0])}  # fmt: skip


def taylor(name, steps=20):
    """Remainders |J(p + dp) - J - dJ/dp dp| of a scene for three dp, each half of that before; of second order."""
    changes = np.array([0.0, 4e-3, 2e-3, 1e-3])
    m = find(name)().finalize(device="cpu", worlds=len(changes), many=False)
    parameter, value = "gravity", np.array([0, 0, -9.81])
    if SCENES[name] == "E":
        owner, members = next(iter(m.parameters.owners().items()))
        parameter = f"{owner}.E"
        value = float(np.ravel(m.parameters.material_of_worlds(*members[0]).constants["E"])[0])
    m.set_parameter(parameter, np.multiply.outer(1.0 + changes, value))
    sim = wf.Simulation(m, dt=1e-3, integrator="bdf2", solver=wf.NewtonPCG(tol=1e-11), constraint_tol=1e-12)
    tape = wf.Adjoint(sim, parameter)
    tape.run(steps)
    probe = m.description.probes[0].name
    loss = wf.loss.sum_of_squares(tape.probe(probe), np.full((steps, 3), TARGET))
    slope = float(np.sum(tape.backward(loss)[parameter].numpy()[0] * value))
    values = loss.numpy()
    remainder = np.abs(values[1:] - values[0] - slope * changes[1:])
    done = {"scene": name, "parameter": parameter, "steps": steps, "remainders": remainder.tolist()}
    return done | {"change": abs(slope * 1e-3), "loss": float(values[0])}


def long_run(steps=1000):
    """The pendulum over a long run: error and growth."""
    lengths = (1e-3, 3e-4, 1e-4)
    shifts = [0.0] + [h * x for h in lengths for x in POINTS]
    m = find("pendulum")(elements=4).finalize(device="cpu", worlds=len(shifts), many=False)
    m.set_parameter("beam.E", 2e6 * (1.0 + np.array(shifts)))
    sim = wf.Simulation(m, dt=1.25e-3, integrator="bdf2", solver=wf.NewtonPCG(tol=1e-12))
    tape = wf.Adjoint(sim, "beam.E")
    tape.run(steps)
    loss = wf.loss.sum_of_squares(tape.probe("tip"), np.full((steps, 3), TARGET))
    exact = [2e6 * tape.backward(loss)["beam.E"].numpy()[0]]
    error = differences(loss.numpy()[1:], exact, lengths)[0]
    return {"scene": "pendulum", "steps": steps, "error": float(error), "growth": float(tape.growth[0])}


def main():
    """Make the file."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=pathlib.Path, required=True)
    parser.add_argument("--rows", default=":")
    options = parser.parse_args()
    first, last = (int(x) if x else None for x in options.rows.split(":"))
    content = provenance_of([], "cpu") | {"command": " ".join(["python", *sys.argv]), "rows": []}
    content["taylor"] = [taylor(name) for name in SCENES]
    content["long"] = long_run()
    for case in cases()[first:last]:
        content["rows"].append(row(*case))
        print(content["rows"][-1], flush=True)
        options.out.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
