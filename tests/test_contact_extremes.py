"""Contact in stiff and extreme cases against closed forms."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import warpfea as wf

G = 9.81


def everywhere(X: np.ndarray) -> np.ndarray:
    """All nodes."""
    return np.ones(len(X), dtype=bool)


def cube(
    b: wf.ModelBuilder, E: float, *, origin: Any = (0.0, 0.0, 0.0), cells: Any = (1, 1, 1), map: Any = None
) -> Any:
    """A cube of 0.1 m and 1 kg."""
    mesh = wf.mesh.box((0.1, 0.1, 0.1), cells=cells, origin=origin, map=map)
    return b.add_solid(mesh, material=wf.SVK(E=E, nu=0.3, density=1000.0), name="cube")


def simulation(b: wf.ModelBuilder, dt: float, **options: Any) -> wf.Simulation:
    """On the CPU."""
    return wf.Simulation(b.finalize(device="cpu"), dt=dt, **options)


# friction


@pytest.mark.parametrize("dt", [1e-3, 1e-2])
@pytest.mark.parametrize("E", [1e7, 1e9, 1e11])
@pytest.mark.parametrize("part", [0.98, 1.02])
def test_block_set_on_an_incline_near_its_angle_of_friction(part, E, dt):
    """It comes to rest below the angle, and slides with g (sin - mu cos) above it."""
    mu, count = 0.5, 100
    angle = math.atan(part * mu)
    b = wf.ModelBuilder(gravity=(G * math.sin(angle), 0.0, -G * math.cos(angle)))
    mesh = wf.mesh.box((0.1, 0.1, 0.02), cells=(2, 2, 1))
    body = b.add_solid(mesh, material=wf.SVK(E=E, nu=0.3, density=1000.0), name="block")
    floor = b.add_collider(wf.HalfSpace((0, 0, 1)))
    b.add_contact(body.surface("z-"), floor, mu=mu, restitution=0.3)
    b.add_probe("p", body.surface("z+"))
    sim = simulation(b, dt)
    sim.step(count)
    v = sim.probe("p").velocity[0, :, 0]
    wanted = max(0.0, G * (math.sin(angle) - mu * math.cos(angle)))
    assert (v[-1] - v[-21]) / (20 * dt) == pytest.approx(wanted, abs=1e-3 * G)


@pytest.mark.parametrize("dt", [1e-4, 1e-3, 1e-2])
@pytest.mark.parametrize("E", [1e8, 1e10, 1e11])
def test_stiff_cube_rests_on_a_rough_floor(E, dt):
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    body = cube(b, E)
    floor = b.add_collider(wf.HalfSpace((0, 0, 1)))
    contact = b.add_contact(body, floor, mu=0.5, restitution=0.5)
    sim = simulation(b, dt)
    sim.step(60)
    assert sim.contact_record(contact).force[0, -1, 2] == pytest.approx(G, rel=2e-2)


def momentum_left(integrator: str, E: float, h: float, speed: float) -> float:
    """Change of the momentum of a float32 cube, in ten steps from rest under its weight, that the records do not tell,
    over the impulse of its weight in a step or its momentum at the start; `speed`: along the floor, m/s."""
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    mesh = wf.mesh.box((0.1, 0.1, 0.1), cells=(2, 2, 2))
    body = b.add_solid(mesh, material=wf.SVK(E=E, nu=0.3, density=1000.0), element="T10")
    contact = b.add_contact(body, b.add_collider(wf.HalfSpace((0, 0, 1))), mu=0.3, restitution=0.5)
    model = b.finalize(device="cpu", dtype="float32")
    state = wf.solve_static(model, stabilise=True).state
    v = state.velocity.numpy()
    v[:, :, 0] = speed
    state.velocity.assign(v)
    sim = wf.Simulation(model, state, dt=h, integrator=integrator)
    worst = 0.0
    for _ in range(10):
        before = model.masses.lumped[0] @ sim.state.velocity.numpy()[0].astype(float)
        sim.step()
        after = model.masses.lumped[0] @ sim.state.velocity.numpy()[0].astype(float)
        impulse = h * (sim.contact_record(contact).force[0, -1] + [0.0, 0.0, -G])
        worst = max(worst, float(np.abs(after - before - impulse).max()))
    return worst / max(h * G, speed)


@pytest.mark.parametrize(
    ("integrator", "E", "h", "speed"),
    [
        ("backward_euler", 1e4, 1e-5, 0.0),
        ("energy_momentum", 1e4, 1e-5, 0.0),
        ("generalized_alpha", 1e4, 1e-5, 0.0),
        ("backward_euler", 1e4, 1e-3, 1.0),
    ],
)
def test_motion_in_contact_is_not_rounded_with_places(integrator, E, h, speed):
    """Displacements of 5 mm are rounded to 2e-10 m in float32; over 10 us that changes the damping by some percent."""
    assert momentum_left(integrator, E, h, speed) < 2e-5


@pytest.mark.parametrize("E", [1e5, 1e7, 1e9])
def test_sliding_block_stops_after_its_way(E):
    """v^2 / (2 mu g); backward Euler takes h v / 2 off."""
    mu, v, h = 0.4, 1.0, 1e-3
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    mesh = wf.mesh.box((0.1, 0.1, 0.02), cells=(2, 2, 1))
    body = b.add_solid(mesh, material=wf.SVK(E=E, nu=0.3, density=1000.0), name="block")
    b.set_initial(body, velocity=(v, 0, 0))
    floor = b.add_collider(wf.HalfSpace((0, 0, 1)))
    b.add_contact(body.surface("z-"), floor, mu=mu, restitution=0.3)
    b.add_probe("p", body.surface("z+"))
    sim = simulation(b, h)
    sim.run(0.35)
    assert sim.probe("p").displacement[0, -1, 0] == pytest.approx(v * v / (2.0 * mu * G) - 0.5 * h * v, rel=1e-3)
    assert sim.energies()["friction"][0] == pytest.approx(0.1, rel=6e-3)


@pytest.mark.parametrize(("mu", "sense"), [(0.3, 1.0), (0.3, -1.0), (0.1, 1.0)])
def test_capstan(mu, sense):
    """T_2 = T_1 exp(mu phi R / rho): Euler and Eytelwein, with the tension at the radius rho of the beam's axis."""
    R, thick, phi, leg, pull = 0.1, 2e-3, 0.5 * math.pi, 0.03, 5.0
    rho = R + 0.5 * thick
    first, last = 0.75 * math.pi, 0.25 * math.pi

    def place(a: Any) -> np.ndarray:
        a = np.atleast_1d(a)
        return rho * np.stack([np.cos(a), 0.0 * a, np.sin(a)], axis=1)

    def along(a: float) -> np.ndarray:
        return np.array([math.sin(a), 0.0, -math.cos(a)])

    s = np.linspace(-leg, 0.0, 9)[:-1, None]
    curve = [place(first) + s * along(first), place(np.linspace(first, last, 257)), place(last) - s[::-1] * along(last)]
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    material = wf.SVK(E=1e8, nu=0.0, density=1000.0, damping=wf.KelvinVoigt(2e4, 0.0))
    section = wf.Rectangle(thick, thick)
    cable = b.add_beam(np.concatenate(curve), elements=20, section=section, normal=(0, 1, 0), material=material)
    b.clamp(cable.start, slots="position")
    force = tuple(pull * along(last))
    b.add_point_load(cable.end, ([0, 0.05, 10], [(0, 0, 0), force, force]))
    turn = wf.Rotation(anchor=(0, 0, 0), axis=(0, 1, 0), angle=([0, 0.1, 10.1], [0, 0, 20.0 * sense]))
    drum = b.add_collider(wf.Cylinder(start=(0, -0.1, 0), end=(0, 0.1, 0), radius=R), path=turn)
    b.add_contact(cable, drum, mu=mu, restitution=0.3, stiffness=("region", 10.0), overlap="offset")
    sim = simulation(b, 2e-3)
    sim.step(150)
    held = np.linalg.norm(sim.reaction(cable.start)[0])
    assert held / pull == pytest.approx(math.exp(sense * mu * phi * R / rho), rel=2e-3)


# a turning cylinder under a cube that is held sideways


def cube_on_a_wheel(mu: float, speed: float, h: float, E: float = 1e9) -> tuple[wf.Simulation, Any]:
    """Its weight presses it on the top of a cylinder of 0.05 m."""
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    body = cube(b, E, origin=(-0.05, -0.05, 0.05), cells=(2, 2, 1))
    b.clamp(body.nodes(everywhere), components="xy")
    turn = wf.Rotation(anchor=(0, 0, 0), axis=(0, 1, 0), angle=([0, 100], [0, 100.0 * speed]))
    wheel = b.add_collider(wf.Cylinder(start=(0, -1, 0), end=(0, 1, 0), radius=0.05), path=turn)
    contact = b.add_contact(body, wheel, mu=mu, restitution=0.3)
    return simulation(b, h), contact


@pytest.mark.parametrize("E", [1e7, 1e9, 1e11])
def test_a_turning_wheel_rubs_with_mu_times_the_weight(E):
    sim, contact = cube_on_a_wheel(0.4, 1.0, 2e-3, E)
    sim.step(200)
    assert sim.contact_record(contact).force[0, -1] == pytest.approx([0.4 * G, 0.0, G], rel=1e-4, abs=1e-4)


@pytest.mark.parametrize("speed", [1.0, 10.0, 100.0])
def test_work_of_a_turning_wheel_is_that_of_its_moment(speed):
    h = 2e-3
    sim, contact = cube_on_a_wheel(0.4, speed, h)
    sim.step(150)
    r = sim.contact_record(contact)
    wanted = 0.4 * G * 0.05 * speed * h
    assert r.collider_work[0, -1] == pytest.approx(wanted, rel=1e-2)
    assert r.friction[0, -1] == pytest.approx(wanted, rel=1e-2)


def test_a_smooth_wheel_does_no_work():
    sim, _ = cube_on_a_wheel(0.0, 10.0, 2e-3)
    sim.step(100)
    assert abs(sim.energies()["collider_work"][0]) < 1e-4


# walls, impacts and colliders that move


@pytest.mark.parametrize("E", [1e5, 1e8, 1e11])
def test_a_cube_in_the_corner_of_three_planes(E):
    b = wf.ModelBuilder(gravity=(-G / math.sqrt(3.0),) * 3)
    body = cube(b, E, origin=(1e-4, 1e-4, 1e-4))
    planes = [b.add_collider(wf.HalfSpace(np.eye(3)[i])) for i in range(3)]
    contacts = [b.add_contact(body, plane, restitution=0.3) for plane in planes]
    sim = simulation(b, 1e-2)
    sim.step(150)
    forces = np.array([sim.contact_record(c).force[0, -1] for c in contacts])
    assert forces == pytest.approx(G / math.sqrt(3.0) * np.eye(3), rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("E", [1e7, 1e9, 1e11])
def test_a_cube_in_a_wedge(E):
    """Two smooth planes at 45 degrees bear W / sqrt(2) each."""
    c = math.sqrt(0.5)
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    body = cube(b, E, map=lambda X: X @ np.array([[c, 0, c], [0, 1, 0], [-c, 0, c]]))
    planes = [b.add_collider(wf.HalfSpace((sign * c, 0, c))) for sign in (1.0, -1.0)]
    contacts = [b.add_contact(body, plane, restitution=0.3) for plane in planes]
    sim = simulation(b, 1e-2)
    sim.step(150)
    forces = np.array([sim.contact_record(k).force[0, -1] for k in contacts])
    assert forces == pytest.approx(0.5 * G * np.array([[1, 0, 1], [-1, 0, 1]]), rel=1e-4, abs=1e-4)


@pytest.mark.parametrize(
    ("gap", "E"),
    [(0.0, 1e7), (0.0, 1e9), (0.0, 1e11), (5e-4, 1e7), (5e-4, 1e9), (5e-4, 1e11)],
)
def test_a_moving_box_pushes_a_cube(gap, E):
    """Impulse is momentum, and work is impulse times speed; with no gap it arrives at a step's end within rounding."""
    h, speed = 1e-3, 1.0
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = cube(b, E, origin=(0.01 + gap, 0, 0))
    shape = wf.Box(center=(-0.05, 0.05, 0.05), size=(0.1, 0.3, 0.3))
    box = b.add_collider(shape, path=([0, 10], [(0, 0, 0), (10.0 * speed, 0, 0)]))
    contact = b.add_contact(body, box, restitution=0.3)
    b.add_probe("p", body.at((0.06 + gap, 0.05, 0.05)))
    sim = simulation(b, h)
    sim.step(80)
    r = sim.contact_record(contact)
    impulse = h * r.force[0, :, 0].sum()
    assert impulse == pytest.approx(sim.probe("p").velocity[0, -1, 0], rel=1e-2)
    assert r.collider_work.sum() == pytest.approx(impulse * speed, rel=1e-7)
    assert 1.0 <= impulse <= 2.0


@pytest.mark.parametrize("E", [1e6, 1e9])
def test_a_floor_that_drops_away_does_not_pull(E):
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    body = cube(b, E)
    floor = b.add_collider(wf.HalfSpace((0, 0, 1)), path=([0, 0.1, 0.2], [(0, 0, 0), (0, 0, 0), (0, 0, -1.0)]))
    contact = b.add_contact(body, floor, mu=0.5, restitution=0.3)
    b.add_probe("p", body.surface("z+"))
    sim = simulation(b, 1e-3)
    sim.step(150)
    assert not sim.contact_record(contact).force[0, 102:].any()
    assert sim.probe("p").velocity[0, -1, 2] == pytest.approx(-0.05 * G, rel=1e-3)


@pytest.mark.parametrize("moved", ["parameter", "path"])
def test_a_floor_that_jumps_up_carries_the_block(moved):
    """By 1 mm in a step: the block is above the floor from then on, and rests on it in the end."""
    jump, h = 1e-3, 1e-3
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    body = cube(b, 1e8)
    law = ([0, 0.1, 0.1 + h, 10.0], [(0, 0, 0), (0, 0, 0), (0, 0, jump), (0, 0, jump)]) if moved == "path" else None
    floor = b.add_collider(wf.HalfSpace((0, 0, 1)), path=law, name="floor")
    b.add_contact(body, floor, restitution=0.3)
    sim = simulation(b, h)
    sim.step(100)
    if moved == "parameter":
        sim.model.set_parameter("floor.offset", jump)
    sim.step(300)
    assert sim.positions(body)[0, :, 2].min() == pytest.approx(jump, abs=1e-5)


def test_elastic_bounces_keep_their_height():
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    body = cube(b, 1e10, origin=(0, 0, 0.02))
    b.clamp(body.nodes(everywhere), components="xy")
    floor = b.add_collider(wf.HalfSpace((0, 0, 1)))
    b.add_contact(body.surface("z-"), floor, restitution=1.0, stiffness=("region", 3e-5))
    b.add_probe("p", body.surface("z-"))
    sim = simulation(b, 2e-4, integrator="bdf2")
    sim.step(3000)
    z = sim.probe("p").displacement[0, :, 2]
    tops = z[1:-1][(z[1:-1] > z[:-2]) & (z[1:-1] >= z[2:])]
    assert len(tops) >= 3
    assert np.abs(tops).max() < 0.005 * 0.02


@pytest.mark.parametrize("face", [1.0, -1.0])
@pytest.mark.parametrize("kind", ["beam", "shell"])
def test_thin_bodies_hit_a_cylinder_with_either_face(kind, face):
    """The ledger keeps the energy of the start, and nothing is pushed aside."""
    thick, v, h = 0.005, 2.0, 2e-4
    z = face * (0.035 + 0.5 * thick)
    material = wf.SVK(E=1e8, nu=0.3, density=1000.0)
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    if kind == "beam":
        section = wf.Rectangle(0.06, thick)
        body = b.add_beam(
            [(-0.15, 0, z), (0.15, 0, z)], elements=8, section=section, normal=(0, 0, 1), material=material
        )
    else:
        mesh = wf.mesh.grid((0.3, 0.06), cells=(6, 2), origin=(-0.15, -0.03, z))
        body = b.add_shell(mesh, thickness=thick, material=material)
    b.set_initial(body, velocity=(0, 0, -face * v))
    cylinder = b.add_collider(wf.Cylinder(start=(0, -0.1, 0), end=(0, 0.1, 0), radius=0.03))
    contact = b.add_contact(body, cylinder, mu=0.3)
    sim = simulation(b, h, integrator="bdf2")
    sim.step(100)
    e = {k: float(x[0]) for k, x in sim.energies().items()}
    kept = sum(e[k] for k in ("kinetic", "strain", "contact", "contact_loss", "friction", "integrator"))
    mass = 0.3 * 0.06 * thick * 1000.0
    assert kept == pytest.approx(0.5 * mass * v * v, rel=1e-5)
    impulse = h * sim.contact_record(contact).force[0].sum(axis=0) * face / (mass * v)
    assert impulse[2] > 0.5
    assert np.abs(impulse[:2]).max() < 1e-8


@pytest.mark.parametrize("dtype", ["float64", "float32", "default"])
@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda:0", marks=pytest.mark.cuda)])
def test_a_steel_block_at_rest_after_a_drop_takes_few_iterations(device, dtype):
    """Residuals of the first iterate are roundings there; on 8934ce7 each step took 160 iterations and 127 halvings
    (float32: 13, up to 119). The default stiffness is 13 times that of the region, and so are its roundings; float32,
    with 70 times the weight per digit of a position, takes 35 iterations with it."""
    options = {} if dtype == "default" else {"stiffness": "region", "restitution": 1.0}
    accuracy = {"float64": 1e-6, "float32": 1e-2, "default": 2e-5}[dtype]
    dtype = "float32" if dtype == "float32" else "float64"
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    steel = wf.SVK(E=2.1e11, nu=0.3, density=7850.0)
    block = b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(2, 2, 2), origin=(0, 0, 0.01)), material=steel)
    floor = b.add_collider(wf.HalfSpace(normal=(0, 0, 1)))
    pad = b.add_contact(block, floor, mu=0.3, name="pad", **options)
    sim = wf.Simulation(b.finalize(device=device, dtype=dtype), dt=1e-3)
    sim.step(55)
    newton = [int(sim.step().newton[0]) for _ in range(65)]
    assert np.mean(newton) < 6
    if dtype == "float64":
        assert max(newton) <= 6
    weight = 7850.0 * 1e-3 * 9.81
    assert sim.contact_record(pad).normal_force[0, -1] == pytest.approx(weight, rel=accuracy)
