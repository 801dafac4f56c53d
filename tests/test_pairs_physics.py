"""Contact between bodies against closed forms: waves in two bars, pressure through flat meshes, wedges, impacts."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pairwise import covering

import warpfea as wf
from warpfea.model.discretisation import element_functions

MATERIAL = wf.SVK(E=1e6, nu=0.3, density=1000.0)


# two bars


@pytest.mark.parametrize("integrator", ["backward_euler", pytest.param("bdf2", marks=pytest.mark.slow),
                                        pytest.param("energy_momentum", marks=pytest.mark.slow)])  # fmt: skip
def test_two_equal_bars_exchange_their_velocities(integrator):
    """One-dimensional waves: a force of A rho c v/2 for 2 L/c; the struck bar leaves with v."""
    L, cells, E, rho, v, h, side = 1.0, 40, 1e7, 1000.0, 0.1, 2e-5, 0.05
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    bars = [
        b.add_solid(
            wf.mesh.box((L, side, side), cells=(cells, 1, 1), origin=(x, 0, 0), element="T4"),
            material=wf.SVK(E=E, nu=0.0, density=rho), name=name,
        )
        for name, x in (("striking", -L), ("struck", 0.0))
    ]  # fmt: skip
    b.set_initial(bars[0], velocity=(v, 0, 0))
    pair = b.add_contact(bars[0].surface("x+"), bars[1].surface("x-"), restitution=1.0, stiffness=("region", 20.0))
    model = b.finalize(device="cpu")
    sim = wf.Simulation(model, dt=h, integrator=integrator)
    c = math.sqrt(E / rho)
    sim.step(round(1.1 * 2.0 * L / c / h))
    record = sim.contact_record(pair)
    force, expected = -record.force[0, :, 0] / (side**2 * rho * c * v / 2.0), 2.0 * L / c
    over = record.time[force > 0.01]
    assert force[-1] == 0.0
    assert over[-1] - over[0] == pytest.approx(expected, rel=0.01)
    plateau = (record.time > 0.25 * expected) & (record.time < 0.75 * expected)
    assert force[plateau].mean() == pytest.approx(1.0, rel=0.01)
    mass = model.masses.lumped[0] * (np.arange(len(model.masses.lumped[0])) >= bars[1].slot_offset)
    assert 0.97 * v <= mass @ sim.state.velocity.numpy()[0][:, 0] / mass.sum() <= 1.001 * v


# flat meshes that do not match

TETRA = np.array([[0.25, 0.25, 0.25], [0.5854, 0.1382, 0.1382], [0.1382, 0.5854, 0.1382], [0.1382, 0.1382, 0.5854]])


def stresses(body, state):
    """(E, Q) Cauchy's sigma_zz of a St. Venant-Kirchhoff solid, and (E,) heights of its elements' middles."""
    u = state.displacement.numpy()[0][body.slot_offset : body.slot_offset + body.slot_count]
    conn = body.connectivity
    s, ds = element_functions(body, np.arange(len(conn)), TETRA)
    e = body.reference[conn]
    s, ds = (np.broadcast_to(x, (len(conn), *x.shape[1:])) for x in (s, ds))
    F = np.einsum("esk,eqsd->eqkd", e + u[conn], ds) @ np.linalg.inv(np.einsum("esk,eqsd->eqkd", e, ds))
    strain = 0.5 * (np.swapaxes(F, 2, 3) @ F - np.eye(3))
    E, nu = 1e6, 0.3
    trace = np.trace(strain, axis1=2, axis2=3)[..., None, None] * np.eye(3)
    S = E * nu / ((1 + nu) * (1 - 2 * nu)) * trace + E / (1 + nu) * strain
    sigma = F @ S @ np.swapaxes(F, 2, 3) / np.linalg.det(F)[..., None, None]
    return sigma[..., 2, 2], np.einsum("eqs,esk->eqk", s, e).mean(axis=1)[:, 2] + body.origin[2]


@pytest.mark.parametrize("element", ["T4", "T10"])
@pytest.mark.parametrize("cells", [(4, 3), (2, 5)])
def test_pressure_passes_through_flat_meshes(element, cells):
    """Two blocks between smooth walls, of `cells` across: the mean exactly, a layer from the contact each stress."""
    p, side, layers = 1e3, 0.1, 3
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    blocks = []
    for z, n, name in ((side, cells[0], "upper"), (0.0, cells[1], "lower")):
        mesh = wf.mesh.box((side,) * 3, cells=(n, n, layers), origin=(0, 0, z), element=element)
        body = b.add_solid(mesh, material=MATERIAL, name=name)
        for face, axis in (("x-", "x"), ("x+", "x"), ("y-", "y"), ("y+", "y")):
            b.clamp(body.nodes(face), components=axis)
        blocks.append(body)
    b.clamp(blocks[1].nodes("z-"), components="z")
    b.add_pressure(blocks[0].surface("z+"), p)
    pair = b.add_contact(blocks[0].surface("z-"), blocks[1].surface("z+"))
    result = wf.solve_static(b.finalize(device="cpu"), load_steps=1, tol=1e-10, stabilise=True)
    assert result.contact_force(pair)[0, 2] == pytest.approx(p * side**2, rel=1e-8)
    for body in blocks:
        sigma, height = stresses(body, result.state)
        beyond = np.abs(height - side) > side / layers
        assert 0 < beyond.sum() < len(beyond)
        assert np.abs(sigma[beyond] / -p - 1.0).max() < 0.03


# a block between two wedges


def pressed_force(ratio, element, slow, slope=0.3):
    """Normal force on one side of a block that was pressed between two wedges and let go, at the most and in the end;
    mu = ratio times the slope of its sides."""
    w, wide, h, depth = 0.05, 0.15, 0.1, 0.05

    def half(X):
        return w + slope * X[:, 2]

    def middle(X):
        return np.column_stack([X[:, 0] * half(X) / w, X[:, 1:]])

    def right(X):
        return np.column_stack([half(X) + (X[:, 0] - w) / (wide - w) * (wide - half(X)), X[:, 1:]])

    def left(X):
        return right(np.column_stack([wide + w - X[:, 0], X[:, 1:]])) * (-1.0, 1.0, 1.0)

    def solid(size, cells, origin, place, name):
        mesh = wf.mesh.box(size, cells=cells, origin=origin, map=place, element=element)
        return b.add_solid(mesh, material=MATERIAL, name=name)

    b = wf.ModelBuilder(gravity=(0, 0, 0))
    block = solid((2 * w, depth, h), (2, 1, 2), (-w, 0, 0), middle, "block")
    wedges = [solid((wide - w, depth, 0.14), (2, 2, 3), (w, 0, -0.02), f, f.__name__) for f in (right, left)]
    b.clamp(wedges[0].nodes("x+"))
    b.clamp(wedges[1].nodes("x-"))
    b.add_pressure(block.surface("z+"), ([0.0, slow, 2 * slow, 9.0], [0.0, 100.0, 0.0, 0.0]))
    options = {"mu": ratio * slope, "stiffness": ("region", 10.0)}
    pair = b.add_contact(block.surface("x+"), wedges[0].surface("x-"), **options)
    b.add_contact(block.surface("x-"), wedges[1].surface("x+"), **options)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=2e-3)
    sim.step(round((2.0 * slow + 0.2) / 2e-3))
    force = sim.contact_record(pair).normal_force[0]
    return force.max(), force[-1]


@pytest.mark.parametrize(("element", "slow"), [("T4", 0.1), pytest.param("T10", 0.2, marks=pytest.mark.slow)])
def test_a_block_between_wedges_stays_or_leaves(element, slow):
    """Any normal force pushes it out below mu = tan of the half angle; above it stays where it was pressed to."""
    most, left = pressed_force(0.99, element, slow)
    assert most > 0.5
    assert left == 0.0
    most, left = pressed_force(1.01, element, slow)
    assert left > 0.4 * most


# impacts


def turned(axis, angle):
    a = np.asarray(axis) / np.linalg.norm(axis)
    K = np.cross(np.eye(3), -a)
    return np.eye(3) + math.sin(angle) * K + (1.0 - math.cos(angle)) * K @ K


TURN = {
    "vertex": turned((1.0, -1.0, 0.0), math.atan(math.sqrt(2.0))),
    "edge": turned((1.0, 0.0, 0.0), math.pi / 4.0),
    "flat": np.eye(3),
}


def falling(how, *, speed, gap, cells=(2, 3), E=1e6, dt=1e-3, gravity=0.0, **options):
    """A cube over a clamped plate, turned so that a vertex, an edge or a face comes first."""
    side = 0.1
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * side
    low = (corners @ TURN[how].T)[:, 2].min()
    shift = np.array([0.0113, 0.0071, gap - low])
    b = wf.ModelBuilder(gravity=(0, 0, -gravity))
    material = wf.SVK(E=E, nu=0.3, density=1000.0)
    cube = wf.mesh.box((side,) * 3, cells=(cells[0],) * 3, origin=(-0.5 * side,) * 3, element="T4",
                       map=lambda X: X @ TURN[how].T + shift)  # fmt: skip
    plate = wf.mesh.box((0.3, 0.3, side), cells=(cells[1], cells[1], 1), origin=(-0.15, -0.15, -side), element="T4")
    upper, lower = (b.add_solid(x, material=material, name=n) for x, n in ((cube, "cube"), (plate, "plate")))
    b.clamp(lower.nodes("z-"))
    b.set_initial(upper, velocity=(0, 0, -speed))
    pair = b.add_contact(upper, lower, mu=0.3, **({"restitution": 0.5} | options))
    return wf.Simulation(b.finalize(device="cpu"), dt=dt), upper, lower, pair


CELLS = {"cube": (2, 3), "plate": (1, 6)}
"""By the slave."""


@pytest.mark.parametrize("slave", CELLS)
@pytest.mark.parametrize("how", TURN)
def test_what_falls_on_a_plate_comes_back(how, slave):
    """No restitution, friction or meshes make it stick or fail, and energy is only lost."""
    sim, upper, _, pair = falling(how, speed=0.5, gap=1e-3, cells=CELLS[slave], stiffness=("region", 10.0))
    assert pair.slave.body.name == slave
    newton = [int(sim.step().newton[0]) for _ in range(130)]
    force, energies = sim.contact_record(pair).normal_force[0], sim.energies()
    assert force.max() > 1.0
    assert force[-1] == 0.0
    assert 0.05 < sim.velocities(upper)[0][:, 2].mean() < 0.5
    assert max(newton) <= 20
    assert abs(energies["ledger_residual"][0]) <= 1e-6 * 0.125
    assert energies["contact_loss"][0] > 0.0
    assert energies["friction"][0] >= 0.0


@pytest.mark.parametrize("how", TURN)
@pytest.mark.parametrize("speed", [0.0, 0.2, -0.2])
def test_coincident_start(how, speed):
    """Bodies that touch at the start rest, are pressed together, or part without a force."""
    sim, upper, _, pair = falling(
        how, speed=speed, gap=0.0, stiffness=("region", 10.0), gravity=0.0 if speed < 0.0 else 9.81
    )
    sim.step(60)
    force = sim.contact_record(pair).normal_force[0]
    if speed < 0.0:
        assert force.max() == 0.0
        assert sim.velocities(upper)[0] == pytest.approx(np.broadcast_to((0, 0, -speed), (27, 3)), abs=1e-9)
    else:
        assert sim.positions(upper)[0][:, 2].mean() > 0.03
        assert force.max() >= 9.81


@pytest.mark.parametrize(("how", "slave"), covering(TURN, CELLS, strength=1))
@pytest.mark.parametrize("dt", [1e-2, pytest.param(1e-3, marks=pytest.mark.slow)])
def test_an_impact_beyond_the_law_is_refused(how, slave, dt):
    """100 m/s: the energy of 1 kg is 5 kJ, what the contact can store before its depth is reached is some joules."""
    sim, upper, _, pair = falling(how, speed=100.0, gap=0.013, cells=CELLS[slave], dt=dt, stiffness="region")
    assert pair.slave.body.name == slave
    with pytest.raises(wf.PenetrationError, match=r"went through body .*take a larger stiffness="):
        sim.step(20)
    assert sim.positions(upper)[0][:, 2].mean() > 0.0


@pytest.mark.parametrize("slave", CELLS)
def test_without_a_potential_it_is_refused_too(slave):
    """Midpoint schemes compare residuals, which are small behind the plate: cubes passed it with `converged`."""
    sim, upper, *_ = falling("flat", speed=100.0, gap=0.013, cells=CELLS[slave], stiffness="region")
    sim = wf.Simulation(sim.model, dt=1e-3, integrator="energy_momentum")
    with pytest.raises(wf.PenetrationError, match=r"went through body"):
        sim.step(20)
    assert sim.positions(upper)[0][:, 2].mean() > 0.0


@pytest.mark.parametrize("how", TURN)
def test_a_fast_impact_within_the_law_comes_back(how):
    sim, upper, *_ = falling(how, speed=100.0, gap=0.013, E=1e9, stiffness="region")
    sim.step(20)
    assert sim.positions(upper)[0][:, 2].mean() > 0.05
    assert sim.velocities(upper)[0][:, 2].mean() > 1.0


# explicit law, all nodes driven


@pytest.mark.parametrize("first", ["upper", "lower"])
def test_explicit_paper_law_on_a_random_sequence(first):
    """Eqs. (73) to (83) written anew for the face of a cube on a slab that both move without strain."""
    rng = np.random.default_rng(3)
    h, count, E, nu, e, mu, side = 0.01, 60, 2e6, 0.3, 0.4, 0.35, 0.1
    times = h * np.arange(count + 1)
    u, w = (rng.uniform(-1, 1, (count + 1, 3)) * (0.0004, 0.0004, 0.001) for _ in range(2))
    u[0] = w[0] = 0.0
    low = 2e-4
    b = wf.ModelBuilder()
    bodies = []
    for name, size, place, path in (
        ("upper", (side,) * 3, (0.05, 0.05, low), u), ("lower", (0.2, 0.2, side), (0.0, 0.0, -side), w),
        ("free", (side,) * 3, (5.0, 0.0, 5.0), None),
    ):  # fmt: skip
        mesh = wf.mesh.box(size, cells=(2, 2, 1), origin=place, element="T4")
        body = b.add_solid(mesh, material=wf.SVK(E=E, nu=nu, density=1000.0), name=name)
        if path is not None:
            b.drive(body.nodes(lambda X: np.ones(len(X), dtype=bool)), displacement=(times, path))
        bodies.append(body)
    faces = [bodies[0].surface("z-"), bodies[1].surface("z+")]
    sign = 1.0 if first == "upper" else -1.0
    pair = b.add_contact(
        *faces[:: int(sign)],
        law="paper",
        treatment="explicit",
        mu=mu,
        restitution=e,
        stiffness=("region", 2.0),
        name="pair",
    )
    assert pair.slave.body is bodies[0]
    sim = wf.Simulation(b.finalize(device="cpu"), dt=h)
    sim.step(count)
    got = sign * sim.contact_record("pair").force[0]

    a, mass = math.sqrt(side**2 / math.pi), 1.0 / (1.0 / 1.0 + 1.0 / 4.0)
    modulus, shear = E / (1.0 - nu**2) / 2.0, E / (2.0 * (1.0 + nu)) / (2.0 - nu) / 2.0
    k_n, k_t = 2.0 * 4.0 / 3.0 * modulus * a, 2.0 * 8.0 * shear * a
    c = 2.0 * math.sqrt(5.0 / 6.0) * math.log(e) / math.hypot(math.log(e), math.pi)
    gamma_n, gamma_t = -c * math.sqrt(2.0 * 2.0 * modulus * a * mass), -c * math.sqrt(mass * k_t)
    spring, want, slid = np.zeros(2), np.zeros((count, 3)), 0
    for i in range(count):
        before = max(i - 1, 0)
        v = (u[i] - u[before] - w[i] + w[before]) / h
        d = w[i, 2] - u[i, 2] - low
        if d <= 0.0:
            spring = np.zeros(2)
            continue
        normal = max(0.0, k_n * d - gamma_n * v[2])
        spring = spring + h * v[:2]
        pull = -k_t * spring - gamma_t * v[:2]
        if np.linalg.norm(pull) > mu * normal:
            pull *= mu * normal / np.linalg.norm(pull)
            spring = -(pull + gamma_t * v[:2]) / k_t
            slid += 1
        want[i] = *pull, normal
    acts = np.abs(want[:, 2]) > 0.0
    assert 0.2 < acts.mean() < 0.8
    assert 0 < slid < acts.sum()
    assert np.abs(got - want).max() <= 1e-11 * np.abs(want).max()
