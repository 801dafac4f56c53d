"""Every kind of term: its derivatives by all its parameters, controls and the initial state, or its refusal by name.

A kind of term that is registered and stands nowhere here fails.
"""

from types import SimpleNamespace

import numpy as np
import parameter_models as models
import pytest
import warp as wp
from gradient_models import LENGTHS, SOLVER, WEIGHTS, controls, linked, shifts

import warpfea as wf
from warpfea.contact.colliders import ColliderContact
from warpfea.contact.facets import FacetContact
from warpfea.simulation.adjoint import check_terms
from warpfea.terms.constraints import Constraints
from warpfea.terms.elements import Damping, Elements
from warpfea.terms.follower_loads import FollowerLoads
from warpfea.terms.loads import BodyForces, DeadLoads
from warpfea.terms.springs import Springs
from warpfea.terms.term_set import TERM_TYPES
from warpfea.terms.velocity_rows import VelocityRows

STEPS = 6
TOLERANCE, ROUND_OFF = 1e-8, 1e-11
"""Relative errors of derivatives, and of the loss over their lengths of differences."""
GRAVITY = np.array([0.0, 3.0, -9.81])
VALUES = {
    "hip.stiffness": 0.3, "hip.damping": 2e-3, "servo.kp": 0.5, "servo.kd": 5e-3, "servo.limit": 10.0,
    "knee.stop_stiffness": 2.0, "knee.stop_damping": 3e-3, "knee.upper": -0.02, "knee.lower": -1.0, "weak.kp": 1.0,
    "weak.kd": 0.01, "weak.limit": 0.03, "s.stiffness": 20.0, "s.damping": 0.1, "s.rest": 0.08, "bed.stiffness": 2e4,
    "bed.damping": 30.0, "hip.friction": 0.05, "knee.friction": 1e-3,
    "mount.stiffness": np.array((20, 30, 10, 0.02, 0.03, 0.04)),
    "mount.damping": np.array((0.1, 0.2, 0.3, 1e-3, 1.2e-3, 1.5e-3)),
}  # fmt: skip
"""Parameters of the models besides those of materials: in "friction" one joint sticks, the other slips."""


def damped(worlds):
    m = models.model(models.solid("T4"), models.material(), worlds)
    m.many = False
    return m


@wp.func
def swirl(x: wp.vec3d, t: wp.float64) -> wp.vec3d:
    return wp.float64(1e3) * wp.vec3d(-x[1], x[0] * x[0], wp.sin(wp.float64(9.0) * x[1]))


def force_field(worlds, density=1100.0):
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    models.solid("T4")(b, models.material(density=density))
    b.add_body_force(swirl)
    return b.finalize(device="cpu", worlds=worlds, many=False)


def velocity_rows(worlds=1):
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    models.solid("T4")(b, models.material())
    part = b.add_rigid(wf.Box((0.3, 0, 0), (0.1, 0.1, 0.1)), density=1000.0)
    with pytest.raises(wf.ModelError, match="got the body"):
        b.add_joint("revolute", parent=wf.GROUND, child=part, anchor=(0.3, 0, 0), axis=(0, 0, 1))
    hinge = b.add_joint("revolute", parent=wf.GROUND, child=part.at((0.3, 0, 0)), axis=(0, 0, 1))
    b.add_velocity_constraint("speed", hinge, value=1.0)
    return b.finalize(device="cpu", worlds=worlds)


def of_kind(kind):
    return lambda worlds: linked(kind, worlds)


MODELS = {
    "damped": (damped, (Elements, DeadLoads, Damping)),
    "springs": (of_kind("springs"), (Springs, Constraints)),
    "friction": (of_kind("friction"), (Springs,)),
    "field": (force_field, (BodyForces,)),
    "followers": (of_kind("followers"), (FollowerLoads,)),
}
REFUSED = {VelocityRows: velocity_rows}
ELSEWHERE = {ColliderContact, FacetContact}  # test_gradients_contact.py
CASES = [(kind, "backward_euler") for kind in MODELS] + [("springs", "bdf2"), ("friction", "bdf2")]
SLOW = [("springs", "bdf2"), ("friction", "bdf2"), ("friction", "backward_euler")]


def test_every_kind_of_term_is_here():
    checked = {kind for _, kinds in MODELS.values() for kind in kinds}
    assert set(TERM_TYPES) == checked | set(REFUSED) | ELSEWHERE


@pytest.mark.parametrize("kind", REFUSED)
def test_the_others_are_refused_by_name(kind):
    m, ctx = REFUSED[kind](), SimpleNamespace(inertia=True, midpoint=False, accelerated=False)
    assert any(isinstance(term, kind) for term in m.terms)
    with pytest.raises(wf.ModelError, match=f"{kind.name!r} has no adjoint"):
        check_terms(m, ctx)


def value_of(m, name):
    """Value of a parameter of `set_parameter`."""
    owner, _, key = name.rpartition(".")
    owners = m.parameters.owners()
    if name == "gravity":
        return GRAVITY
    if owner in owners:
        (body, k), *_ = owners[owner]
        return body.materials[k][1].constants[key]
    return VALUES[name]


@pytest.mark.parametrize(
    ("kind", "scheme"), [pytest.param(*case, marks=[pytest.mark.slow] * (case in SLOW)) for case in CASES]
)
def test_derivatives_of_terms(kind, scheme):
    make, kinds = MODELS[kind]
    given = controls(kind, STEPS)
    lone = make(1)
    assert all(any(isinstance(term, one) for term in lone.terms) for one in kinds)
    ctx = wf.Simulation(lone, dt=2e-3).stepper.ctx
    names = list(dict.fromkeys(name for term in lone.terms for name in term.gradients(ctx)))
    names = [name for name in names if kind != "field" or name != "body.density"]  # not of each world
    sizes = {"velocity": 1e-2} if lone.constraints else {"velocity": 1e-2, "displacement": 1e-4}
    every = [*names, *given, *(f"initial.{array}" for array in sizes)]
    rows = shifts(len(every))
    m, of = make(len(rows)), {name: 1.0 + rows[:, k] for k, name in enumerate(every)}
    for name in names:
        m.set_parameter(name, np.multiply.outer(of[name], value_of(m, name)))
    state, rng = m.state(), np.random.default_rng(1)
    start = {}
    for array, size in sizes.items():
        start[f"initial.{array}"] = size * rng.standard_normal((m.slots, 3))
        getattr(state, array).assign(np.multiply.outer(of[f"initial.{array}"], start[f"initial.{array}"]))
    sim = wf.Simulation(m, state, dt=2e-3, integrator=scheme, solver=SOLVER, constraint_tol=1e-12)
    tape = wf.Adjoint(sim, every)
    for step in range(STEPS):
        for name, values in given.items():
            sim.controls[name][:] = np.multiply.outer(of[name], values[step])
        tape.run(1)
    loss = wf.loss.sum_of_squares(tape.probe("tip").displacement, np.zeros((1, STEPS, 3)))
    g = {name: array.numpy() for name, array in tape.backward(loss).items()}
    exact = [
        np.sum(g[n][0] * (given | start)[n] if n in given or n in start else g[n][0] * value_of(m, n)) for n in every
    ]
    values = loss.numpy()
    found = values[1:].reshape(len(every), len(LENGTHS), 4) @ WEIGHTS / np.array(LENGTHS)
    errors = np.abs(found - np.array(exact)[:, None]).min(axis=1)
    bounds = TOLERANCE * np.abs(exact) + ROUND_OFF * values[0]
    wrong = {n: (float(e), float(x)) for n, e, b, x in zip(every, errors, bounds, exact) if not e <= b}
    assert not wrong
    if (kind, scheme) in SLOW or kind == "friction":
        with pytest.raises(wf.ModelError, match=r"friction of joints has no|stops in steps of bdf2 have no"):
            tape.forward({})
        return
    v = {
        n: np.broadcast_to((given | start)[n] if n in given or n in start else value_of(m, n), g[n].shape)
        for n in every
    }
    change = tape.forward(v)["tip"].displacement.numpy()
    left = np.sum(change * tape.probe("tip").displacement.grad.numpy(), axis=(1, 2))
    parts = np.array([np.sum((g[n] * v[n]).reshape(len(rows), -1), axis=1) for n in every])
    assert np.abs(left - parts.sum(axis=0)).max() < TOLERANCE * np.abs(parts).max()


def test_density_under_a_force_per_mass():
    def run(factor):
        m = force_field(1, 1100.0 * factor)
        tape = wf.Adjoint(wf.Simulation(m, dt=2e-3, solver=SOLVER), "body.density")
        tape.run(STEPS)
        return tape, wf.loss.sum_of_squares(tape.probe("tip").displacement, np.zeros((1, STEPS, 3)))

    tape, loss = run(1.0)
    values = np.array([run(1.0 + 1e-2 * k)[1].numpy()[0] for k in (-2.0, -1.0, 1.0, 2.0)])
    assert tape.backward(loss)["body.density"].numpy()[0] * 1100.0 == pytest.approx(values @ WEIGHTS / 1e-2, rel=1e-7)
