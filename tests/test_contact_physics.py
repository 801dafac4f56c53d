"""Contact through Simulation against laws written anew here; friction against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from contact_cubes import G, cube, everywhere, middle, record, tilted

import warpfea as wf
from warpfea.model.contact_points import contact_points

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]


def force_of(row):
    return np.array([row["force_x"], row["force_y"], row["force_z"]])


# laws through Simulation, all nodes driven


def driven(values, times, options, path=None, low=1e-4, shape=None, device="cpu", dtype="float64"):
    """A cube on its corner, all nodes driven, over a plane `low` below it; a free body is there to be solved for."""
    b = wf.ModelBuilder()
    body = cube(b, map=tilted, material=wf.SVK(E=2e6, nu=0.3, density=1000.0))
    b.drive(body.nodes(everywhere), displacement=(times, values))
    cube(b, "free", origin=(5.0, 0.0, 5.0))
    floor = b.add_collider(shape or wf.HalfSpace((0, 0, 1), -low), path=path)
    contact = b.add_contact(body, floor, model="sphere", radius=0.3, **{"restitution": 1.0, **options})
    X = contact_points(contact.surface).X.reshape(-1, 3)
    return wf.Simulation(b.finalize(device=device, dtype=dtype), dt=times[1] - times[0]), contact, X[X[:, 2].argmin()]


@pytest.mark.parametrize("shape", ["plane", "sphere"])
@pytest.mark.parametrize(("dtype", "bound"), [("float64", 1e-10), ("float32", 2e-5)])
@pytest.mark.parametrize("device", DEVICES)
def test_sphere_is_hertz(device, dtype, bound, shape):
    times, depths = 0.1 * np.arange(7), np.array([0.0, -1e-3, 1e-5, 1e-3, 1e-2, 4e-3, 2e-2])
    values = np.zeros((7, 3))
    values[:, 2] = -depths
    ball = wf.Sphere((0.08, 0.0, -0.5), 0.5)  # below the corner
    sim, contact, _ = driven(
        values, times, {}, low=0.0, shape=ball if shape == "sphere" else None, device=device, dtype=dtype
    )
    R = 1.0 / (1.0 / 0.3 + (1.0 / 0.5 if shape == "sphere" else 0.0))
    for d in np.maximum(depths[1:], 0.0):
        sim.step()
        hertz = 4.0 / 3.0 * 2e6 / (1.0 - 0.3**2) * math.sqrt(R) * d**1.5
        assert force_of(record(sim, contact)) == pytest.approx([0.0, 0.0, hertz], rel=bound, abs=1e-9)


@pytest.mark.parametrize("turning", [False, True], ids=["fixed plane", "turning plane"])
@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("device", DEVICES)
def test_explicit_paper_law_on_a_random_sequence(device, turning, seed):
    """Eqs. (73) to (83) written anew; the plane's velocity is that of the step to come."""
    rng = np.random.default_rng(seed)
    h, count, low, R, E, nu, e, mu, mass = 0.01, 200, 1e-4, 0.3, 2e6, 0.3, 0.4, 0.35, 1.0
    times = h * np.arange(count + 1)
    u = rng.uniform(-1, 1, (count + 1, 3)) * (0.004, 0.004, 0.002) - (0.0, 0.0, 0.0005)
    u[0] = 0.0
    angle = rng.uniform(-0.05, 0.05, count + 1) * turning
    angle[0] = 0.0
    axis, anchor = np.array([0.6, 0.8, 0.0]), np.array([0.1, 0.2, -low])
    path = wf.Rotation(anchor=tuple(anchor), axis=tuple(axis), angle=(times, angle)) if turning else None
    options = {"law": "paper", "treatment": "explicit", "mu": mu, "restitution": e}
    sim, contact, corner = driven(u, times, options, path, low, device=device)
    got = []
    for _ in range(count):
        sim.step()
        got.append(force_of(record(sim, contact)))

    W = np.cross(np.eye(3), axis)
    turns = [np.eye(3) + math.sin(a) * W + (1.0 - math.cos(a)) * W @ W for a in angle]
    modulus, shear = E / (1.0 - nu**2), E / (2.0 * (1.0 + nu)) / (2.0 - nu)
    c = 2.0 * math.sqrt(5.0 / 6.0) * math.log(e) / math.hypot(math.log(e), math.pi)
    spring, want = np.zeros(3), np.zeros((count, 3))
    for i in range(count):
        n, r = turns[i][:, 2], corner + u[i] - anchor
        v = (u[i] - u[max(i - 1, 0)]) / h - (turns[i + 1] @ turns[i].T @ r - r) / h
        d, v_n = -n @ r, v @ n
        if d <= 0.0:
            spring = np.zeros(3)
            continue
        a, v_t = math.sqrt(R * d), v - v_n * n
        k_t = 8.0 * shear * a
        gamma_t = -c * math.sqrt(mass * k_t)
        normal = max(0.0, 4.0 / 3.0 * modulus * a * d + c * math.sqrt(2.0 * modulus * a * mass) * v_n)
        spring = spring + h * v_t
        spring = spring - n * (n @ spring)
        pull = -k_t * spring - gamma_t * v_t
        if np.linalg.norm(pull) > mu * normal:
            pull *= mu * normal / np.linalg.norm(pull)
            spring = -(pull + gamma_t * v_t) / k_t
        want[i] = normal * n + pull
    assert 0.3 < (np.abs(want[:, 2]) > 0.0).mean() < 0.8
    assert np.abs(np.array(got) - want).max() <= 1e-12 * np.abs(want).max()


# friction


def block(model="patch", *, mu, mu_static=None, guided=False, h=0.02, g=(0, 0, -G), stiffness=1e-2, device="cpu",
          **options):  # fmt: skip
    """A stiff cube on a plane, on its face or, guided along x at a depth of 0.2 mm, on its corner."""
    b = wf.ModelBuilder(gravity=g)
    floor = b.add_collider(wf.HalfSpace((0, 0, 1)))
    map = tilted if model == "sphere" else None
    body = cube(b, map=map)
    if guided:
        b.drive(body.nodes(everywhere), displacement=([0, 0.2], [(0, 0, 0), (0, 0, -2e-4)]), components="yz")
    options |= {"model": model, "radius": 0.05 if model == "sphere" else None}
    surface = body if model == "sphere" else body.surface("z-")
    contact = b.add_contact(
        surface, floor, mu=mu, mu_static=mu_static, restitution=0.3, stiffness=("region", stiffness), **options
    )  # fmt: skip
    b.add_probe("p", body.at(middle(map)))
    model = b.finalize(device=device)
    return model, wf.Simulation(model, dt=h, solver=wf.NewtonPCG(tol=1e-10)), contact


def tilt(model, angle):
    model.set_gravity((G * math.sin(angle), 0.0, -G * math.cos(angle)))


def tangent_at_slip(model_name, mu, mu_static=None, guided=False, h=0.02, start=0.0):
    """The tangent at which all points slip, gravity tilted by 1 deg/s from `start` (rad) on."""
    g = (1e-2, 0, 0) if guided else (0, 0, -G)
    model, sim, contact = block(model_name, mu=mu, mu_static=mu_static, guided=guided, h=h, g=g)
    pressed = 0.0
    if guided:
        sim.step(round(0.6 / h))
        pressed = record(sim, contact)["normal_force"]

    def load(angle):
        if guided:  # the mass is 1 kg
            model.set_gravity((pressed * math.tan(angle), 0.0, 0.0))
        else:
            tilt(model, angle)

    sim.step(round(1.0 / h))  # a body that still rocks sticks anew where it slipped
    quick = math.radians(10.0) * h
    for angle in np.arange(quick, start, quick):
        load(angle)
        sim.step()
    for i in range(round(3.0 / h)):
        angle = start + math.radians((i + 1) * h)
        load(angle)
        sim.step()
        row = record(sim, contact)
        if row["stick"] == 0.0 and row["slip"] > 0.0:
            return math.tan(angle)
    return math.inf


@pytest.mark.parametrize("mu", [0.1, 0.3, 0.8])
@pytest.mark.parametrize("model", ["patch", "sphere"])
def test_incline_slips_at_its_angle_of_friction(model, mu):
    wanted = math.atan(mu)
    tangent = tangent_at_slip(model, mu, guided=model == "sphere", start=wanted - math.radians(0.6))
    assert 0.995 < math.atan(tangent) / wanted < 1.005


@pytest.mark.parametrize("device", DEVICES)
def test_steady_slip_accelerates_as_it_should(device):
    """And backward Euler's own sum gives the place."""
    angle, h, count = math.radians(25.0), 1e-2, 60
    model, sim, _ = block(mu=0.3, h=h, device=device)
    for _ in range(40):
        tilt(model, 0.0)
        sim.step()
    tilt(model, angle)
    sim.step(count)
    x = sim.probe("p").displacement[0, :, 0]
    a = G * (math.sin(angle) - 0.3 * math.cos(angle))
    second = np.diff(x[-50:], 2) / h**2
    assert np.abs(second - a).max() < 1e-6 * G
    n = np.arange(1, 41)
    v = (x[-41] - x[-42]) / h
    assert x[-40:] == pytest.approx(x[-41] + n * h * v + a * h * h * n * (n + 1) / 2, rel=1e-6)


def test_smooth_law_creeps_as_its_formula_says():
    mu, tangent, v_eps = 0.5, 0.3, 1e-3
    b = wf.ModelBuilder(gravity=(G * tangent / math.hypot(1, tangent), 0, -G / math.hypot(1, tangent)))
    body = cube(b, origin=(0, 0, 1e-4), material=wf.SVK(E=1e8, nu=0.3, density=1000.0))
    floor = b.add_collider(wf.HalfSpace((0, 0, 1)))
    b.add_contact(
        body.surface("z-"), floor, mu=mu, restitution=0.3, law="smooth", smoothing=(0.01, v_eps), stiffness=0.1
    )  # fmt: skip
    b.add_probe("p", body.at(middle(origin=(0, 0, 1e-4))))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-2, solver=wf.NewtonPCG(tol=1e-10))
    sim.step(300)
    part = tangent / mu
    assert sim.probe("p").velocity[0, -1, 0] == pytest.approx(v_eps * part / math.sqrt(1.0 - part**2), rel=1e-9)


@pytest.mark.parametrize(("tangent", "slides"), [(0.249, False), (0.251, True)])
def test_static_friction_of_one_contact(tangent, slides):
    model, sim, contact = block("sphere", mu=0.2, mu_static=0.25, guided=True, g=(1e-2, 0, 0))
    sim.step(30)
    pressed = record(sim, contact)["normal_force"]
    for i in range(200):
        model.set_gravity((tangent * pressed * min(1.0, i / 50), 0.0, 0.0))
        sim.step()
    x = sim.probe("p").displacement[0, :, 0]
    if slides:
        assert x[-1] - x[-100] > 0.5
    else:
        assert x[-1] - x[-100] < 1e-9


def softening(x, share, mu_static, mu):
    """The tangent at which a rigid cube begins to slide, as its points at x, over its edge, soften in turn."""
    for tangent in np.arange(mu, mu_static, 1e-5):
        pressure = 1.0 + 0.5 * tangent * x / np.sum(share * x * x)  # the moment of its weight, half an edge above
        holds = [np.sum(share * np.where(q <= mu_static * pressure + 1e-15, q, mu * pressure))
                 for q in mu_static * pressure]  # fmt: skip
        if max(holds) < tangent:
            return tangent
    return mu_static


def test_static_friction_of_a_stiff_cube_with_patches():
    """It slides before mu_static, where the loads at its points say; 0.209 with a continuous pressure."""
    model, _, contact = block(mu=0.2, mu_static=0.25)
    p = contact_points(contact.surface)
    x, share = p.X[..., 0].ravel() / 0.1 - 0.5, p.area.ravel() / p.area.sum()
    wanted = softening(x, share, 0.25, 0.2)
    measured = tangent_at_slip("patch", 0.2, 0.25, h=0.01, start=math.atan(wanted) - math.radians(0.6))
    assert measured == pytest.approx(wanted, abs=5e-4)
    assert measured == pytest.approx(0.209, abs=3e-3)
    fine = (np.arange(400) + 0.5) / 400 - 0.5
    assert softening(fine, np.full(400, 1 / 400), 0.25, 0.2) == pytest.approx(0.209, abs=2e-4)
