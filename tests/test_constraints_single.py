"""Single constraints and their kinds of points: definitions, derivatives, reactions."""

import warnings

import numpy as np
import pytest
import warp as wp
from constraint_models import bodies, box, places, random_pose, state_at, wave

import warpfea as wf
from warpfea.model import assembly

SINGLE = {
    "DP1": lambda p, q: (p.at((0, 0, 0)), p.at((1, 0.2, 0.2)), q.at((1, 0, 0)), q.surface("x+")),
    "DP1 with places": lambda p, q: (p.at((0, 0, 0)), p.surface("x+"), (0, 0, 0), (0, 1, 2)),
    "DP2": lambda p, q: (p.at((0, 0, 0)), p.at((1, 0.2, 0.2)), p.at((0.5, 0.1, 0)), q.at((2, 0, 0))),
    "DIST": lambda p, q: (p.at((0.2, 0.1, 0.1)), q.surface("x+")),
    "DIST of one body": lambda p, q: (p.at((0.2, 0.1, 0.1)), p.surface("x+")),
    "PIN": lambda p, q: (p.at((0.2, 0.1, 0.1)), q.surface("x+")),
}


@wp.func
def path(t: wp.float64) -> wp.vec3d:
    return wp.vec3d(wp.float64(-1.8), wp.sin(t), wp.float64(0.1))


@pytest.mark.parametrize("case", SINGLE)
@pytest.mark.parametrize("sort", ["constant", "samples", "function"])
def test_single_constraints_match_their_definition_and_differences(case, sort):
    kind = case.split()[0]
    b, p, q = bodies()
    points = SINGLE[case](p, q)
    if kind == "PIN":
        value = {"constant": (1.0, 2.0, 3.0), "samples": ([0, 1], [(1, 2, 3), (2, 3, 4)]), "function": path}[sort]
    else:
        value = {"constant": 0.7, "samples": ([0, 1], [0.7, 1.7]), "function": wave}[sort]
    joint = b.add_constraint(kind, points=points, value=value)
    model = b.finalize(device="cpu")
    rng = np.random.default_rng(5)
    u = random_pose(model, rng)
    x, position = places(model)

    def place(point):
        if isinstance(point, tuple):
            return np.array(point, dtype=float)
        if isinstance(point, wf.MaterialPoint):
            return point.weights @ (x + u)[point.body.slots[point.slots]]
        slots, weights = assembly.surface_weights(point)
        return weights @ (x + u)[point.body.slots[slots]] / weights.sum()

    P = [place(point) for point in points]
    f = np.array([1.0, 2.0, 3.0]) if kind == "PIN" else 0.7
    if sort == "function" and kind == "PIN":
        f = np.array([-1.8, 0.0, 0.1])
    if kind == "PIN":
        expected = P[0] - P[1] - f
    elif kind == "DIST":
        expected = [np.linalg.norm(P[1] - P[0]) - f]
    else:
        scale = model.size / np.prod([np.linalg.norm(v.value) for v in (joint.rows[0].a, joint.rows[0].b)])
        expected = [scale * ((P[1] - P[0]) @ (P[3] - P[2]) - f)]
    state = state_at(model, u)
    assert model.evaluation.constraint_values(state)[0] == pytest.approx(np.array(expected), abs=1e-12)
    d = rng.normal(size=u.shape)
    h = 1e-5
    ahead, behind = (state_at(model, u + k * h * d) for k in (1, -1))
    J = model.evaluation.constraint_jacobian(state)
    slope = (model.evaluation.constraint_values(ahead) - model.evaluation.constraint_values(behind))[0] / (2 * h)
    assert J @ d.ravel() == pytest.approx(slope, abs=1e-8 * np.abs(slope).max())
    lam = rng.normal(size=model.constraints.count)
    change = model.evaluation.constraint_jacobian(ahead) - model.evaluation.constraint_jacobian(behind)
    bend = change.T @ lam / (2 * h)
    product = model.evaluation.constraint_curvature(state, lam, d)[0].ravel()
    assert product == pytest.approx(bend, abs=1e-8 * max(np.abs(bend).max(), 1e-3))


def test_reaction_of_dp2_is_that_on_its_last_point():
    """A block kept at its height by a DP2: the force is its weight."""
    b = wf.ModelBuilder(gravity=(0, 0, -10.0))
    stiff = wf.SVK(E=1e12, nu=0.3, density=1000.0)
    held, block = box(b, (0, 0, 0), (1, 0.2, 0.2), law=stiff), box(b, (1, 0, 0), (2, 0.2, 0.2))
    b.clamp(held.nodes(lambda X: X[:, 2] < 1e-9))
    points = (held.at((0, 0, 0)), held.at((0, 0, 0.2)), held.at((0, 0, 0.2)), block.surface("z+"))
    joint = b.add_constraint("DP2", points=points, value=0.0)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=0.05)
    sim.step(60)
    assert sim.joint_record(joint).force[0, -20:].mean(axis=0) == pytest.approx([0, 0, 400.0], abs=8.0)


def lifted_arm(dtype):
    """A beam of aluminium that a motor lifts slowly: its own joint carries the weight."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    metal = wf.SVK(E=7e10, nu=0.33, density=2700.0)
    line, section = [(0, 0, 0), (0.5, 0, 0)], wf.Rectangle(0.04, 0.04)
    arm = b.add_beam(line, elements=4, section=section, normal=(0, 0, 1), material=metal)
    angle = np.linspace(0.0, 0.1, 11)
    motor = b.add_joint("revolute", parent=wf.GROUND, child=arm.start, axis=(0, -1, 0), drive=(10.0 * angle, angle))
    sim = wf.Simulation(b.finalize(device="cpu", dtype=dtype), dt=0.01)
    sim.step(20)
    return sim, motor


def test_joint_forces_at_the_rounding_of_float32_are_told():
    sim, motor = lifted_arm("float32")
    assert sim.totals["floored"][0] > 0
    with pytest.warns(wf.ModelWarning, match="float32 rounds"):
        sim.joint_force(motor)
    with warnings.catch_warnings():  # once
        warnings.simplefilter("error")
        sim.joint_record(motor)
        sim, motor = lifted_arm("float64")
        force = sim.joint_force(motor)
    assert force[0, 2] == pytest.approx(2700.0 * 0.04**2 * 0.5 * 9.81, rel=0.1)
