"""Contact through Simulation against closed forms and against laws written anew here."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from warpfea.kernels.terms.contact_data import RECORD

import warpfea as wf
from warpfea.model.contact_points import contact_points
from warpfea.model.handles import SurfaceSet
from warpfea.terms.contact import Contact
from warpfea.terms.contact_tables import law_numbers
from warpfea.terms.facet_tables import beta_of

G = 9.81
STIFF = wf.SVK(E=1e9, nu=0.3, density=1000.0)
"""A cube of it, 0.1 m and 1 kg, is rigid beside a contact of `stiffness` 1e-5."""
TURN = np.array([[0.8, 0.36, 0.48], [0.0, 0.8, -0.6], [-0.6, 0.48, 0.64]])


def tilted(X):
    """A cube turned so that one corner is its lowest, at z = 0."""
    return X @ TURN.T + (0.0, 0.0, 0.06)


def everywhere(X):
    return np.ones(len(X), dtype=bool)


DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]


def cube(b, name="cube", map=None, origin=(0.0, 0.0, 0.0), material=STIFF):
    mesh = wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1), element="T4", origin=origin, map=map)
    return b.add_solid(mesh, material=material, name=name)


def middle(map=None, origin=(0.0, 0.0, 0.0)):
    X = np.array([[0.05, 0.05, 0.05]]) + origin
    return tuple((X if map is None else map(X))[0])


def record(sim, contact):
    """What the last step says of a contact, by name."""
    term = sim.model.terms.find(Contact)
    first = term.report_offset + len(RECORD) * term.tables.number[contact.index]
    return dict(zip(RECORD, sim.stepper.work.report.numpy()[0, first : first + len(RECORD)]))


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
    contact = b.add_contact(body, floor, model="sphere", radius=0.3, **options)
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


# impacts of cubes that move up and down only

WANTED = np.array([0.1, 0.3, 0.5, 0.7, 0.9])


def impact_step(contact, model, v0):
    """Half a period of the contact, s, with a mass of 1 kg."""
    k = contact.stiffness * law_numbers(contact)["normal"]
    return math.pi / math.sqrt(k) if model == "patch" else 2.943 * (1.25 * v0**2 / k) ** 0.4 / v0


def rebound(model, law, treatment, wanted, per_contact):
    """Speed after the impact over that before, for each wanted restitution; one cube for each."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    floor = b.add_collider(wf.HalfSpace((0, 0, 1)))
    contacts = []
    for i, e in enumerate(wanted):
        shift = np.array([0.5 * i, 0.0, 0.0])
        map = (lambda X, s=shift: tilted(X) + s) if model == "sphere" else (lambda X, s=shift: X + s)
        body = cube(b, f"cube{i}", map)
        b.clamp(body.nodes(everywhere), components="xy")
        b.set_initial(body, velocity=(0, 0, -1.0))
        options = {"model": model, "radius": 0.3 if model == "sphere" else None, "law": law, "treatment": treatment}
        surface = body if model == "sphere" else body.surface("z-")
        contacts.append(b.add_contact(surface, floor, restitution=e, stiffness=1e-5, **options))
        b.add_probe(f"p{i}", body.at(middle(map)))
    h = impact_step(contacts[0], model, 1.0) / per_contact
    sim = wf.Simulation(b.finalize(device="cpu"), dt=h, solver=wf.NewtonPCG(tol=1e-10), record=False)
    names = [f"p{i}" for i in range(len(wanted))]
    for _ in range(12):
        sim.step(max(per_contact // 4, 1))
        if all(record(sim, c)["penetration"] < 0.0 or record(sim, c)["area"] == 0.0 for c in contacts) and all(
            sim.probe(p).velocity[0, -1, 2] > 0.0 for p in names
        ):
            break
    return np.array([sim.probe(p).velocity[0, -1, 2] for p in names])


PAPER_GIVES = {"sphere": (0.2527, 0.3971, 0.5503, 0.7182, 0.9020), "patch": (0.2242, 0.3635, 0.5174, 0.6926, 0.8914)}


@pytest.mark.parametrize("model", PAPER_GIVES)
def test_explicit_paper_law_rebounds_as_computed(model):
    assert np.abs(rebound(model, "paper", "explicit", WANTED, 1000) - PAPER_GIVES[model]).max() < 1e-3


@pytest.mark.parametrize("model", PAPER_GIVES)
def test_implicit_paper_law_rebounds_as_computed_when_extrapolated(model):
    coarse, fine = (rebound(model, "paper", "implicit", WANTED, n) for n in (124, 248))
    assert np.abs(2.0 * fine - coarse - PAPER_GIVES[model]).max() < 1e-3


@pytest.mark.parametrize("model", PAPER_GIVES)
def test_default_law_rebounds_as_wanted(model):
    coarse, fine = (rebound(model, "default", "implicit", WANTED, n) for n in (124, 248))
    assert np.abs((2.0 * fine - coarse) / WANTED - 1.0).max() < 0.01


@pytest.mark.parametrize("model", PAPER_GIVES)
def test_explicit_paper_contact_gains_little_energy_at_20_steps(model):
    assert rebound(model, "paper", "explicit", [1.0], 20)[0] ** 2 - 1.0 < 2e-3


def impacts(count, steps, law, per_contact, e=0.5, smoothing=None):
    """Worlds with random speeds and gaps, without halvings: the simulation, and those that have no solution.

    Eq. (77) jumps by gamma v at touch: a mass has no solution where its free end lies so little inside that this
    jump alone would throw it out.
    """
    rng = np.random.default_rng(0)
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    floor = b.add_collider(wf.HalfSpace((0, 0, 1)))
    body = cube(b)
    b.clamp(body.nodes(everywhere), components="xy")
    surface = body.surface("z-")
    contact = b.add_contact(surface, floor, law=law, restitution=e, stiffness=1e-5, smoothing=smoothing)
    h = impact_step(contact, "patch", 1.0) / per_contact
    model = b.finalize(device="cpu", worlds=count)
    speed = 10.0 ** rng.uniform(-2, 1, count)
    gap = rng.uniform(0.0, 2.0, count) * h * speed
    state = model.state()
    u, v = state.displacement.numpy(), state.velocity.numpy()
    u[:, :, 2], v[:, :, 2] = gap[:, None], -speed[:, None]
    state.displacement.assign(u)
    state.velocity.assign(v)
    solver = wf.NewtonPCG(tol=1e-10, max_halvings=0)
    sim = wf.Simulation(model, state, dt=h, solver=solver, on_failure="freeze", record=False)
    sim.step(steps)
    gamma = math.sqrt(contact.stiffness) * law_numbers(contact)["normal_damping"] * beta_of(e)
    inside = h * speed + G * h * h - gap
    return sim, (inside > 0.0) & (inside < gamma * h * gap)


@pytest.mark.parametrize("e", [0.1, 0.5])
@pytest.mark.parametrize("per_contact", [3, 20])
def test_default_law_always_finds_a_solution(e, per_contact):
    sim, _ = impacts(750, 8, "default", per_contact, e)
    assert not sim.status.any()


@pytest.mark.parametrize("per_contact", [3, 20])
def test_paper_patch_ramped_in_always_finds_a_solution(per_contact):
    sim, without = impacts(300, 3, "paper", per_contact, smoothing=1e-3)
    assert without.any()
    assert sim.status.sum() == 0


def test_paper_patch_fails_where_it_has_no_solution_and_only_there():
    sim, without = impacts(3000, 1, "paper", 20)
    assert 30 < without.sum() < 300
    assert ((sim.status != 0) == without).all()


def test_paper_patch_without_solution_raises():
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = cube(b, origin=(0, 0, 0.00099))
    b.clamp(body.nodes(everywhere), components="xy")
    b.set_initial(body, velocity=(0, 0, -1.0))
    floor = b.add_collider(wf.HalfSpace((0, 0, 1)))
    b.add_contact(body.surface("z-"), floor, law="paper", restitution=0.1, stiffness=1e-2)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3, solver=wf.NewtonPCG(max_halvings=0))
    with pytest.raises(wf.ConvergenceError, match="was not accepted"):
        sim.step()


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
        surface, floor, mu=mu, mu_static=mu_static, restitution=0.3, stiffness=stiffness, **options
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


# pressure

SIZE = np.array([0.3, 0.24, 0.12])
LOAD = 2e3


def bulged(X):
    """Nodes moved so that faces are cut unevenly but stay flat."""
    t = np.asarray(X) / SIZE
    return SIZE * (t + 0.3 * t * (1 - t) * (t - 0.2) * (1 + t[:, [1, 2, 0]]))


def solid(b, element, material, cells=(3, 2, 2)):
    kind = element if element in ("T10", "ENMC", "H3843") else "T4"
    mesh = wf.mesh.box(tuple(SIZE), cells=cells, element=kind)
    points = bulged(mesh.points)
    if kind == "T10":
        c = mesh.cells
        for k, (i, j) in enumerate(((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))):
            points[c[:, 4 + k]] = 0.5 * (points[c[:, i]] + points[c[:, j]])
    return b.add_solid(replace(mesh, points=points), material=material, element=element)


def plate(b, material, integration):
    mesh = wf.mesh.grid(tuple(SIZE[:2]), cells=(3, 2))
    return b.add_shell(
        replace(mesh, points=bulged(mesh.points)), thickness=0.02, integration=integration, material=material
    )


def bar(b, material, integration):
    line = [(x, 0.0, 0.0) for x in (0.0, 0.1, 0.16, 0.3)]
    options = {"section": wf.Rectangle(0.04, 0.03), "integration": integration, "material": material}
    return b.add_beam(line, elements=3, normal=(0, 0, 1), **options)


def flat_side(body, sign):
    """The faces at the lowest (1) or the highest (-1) z."""
    z = sign * contact_points(SurfaceSet(body, body.boundary)).X[..., 2]
    return body.surface(body.boundary[(np.ptp(z, axis=1) < 1e-12) & (z.mean(axis=1) < z.min() + 1e-9)])


def pressed(make, nu=0.3, **options):
    """Pressures at the points, Pa, and depths, m, of a body that a uniform dead load presses onto a plane, at rest."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = make(b, wf.SVK(E=1e6, nu=nu, density=1000.0))
    b.add_traction(flat_side(body, -1), (0, 0, -LOAD))
    surface = flat_side(body, 1)
    floor = b.add_collider(wf.HalfSpace((0, 0, 1), contact_points(surface).X[..., 2].min()))
    b.add_contact(surface, floor, restitution=0.3, **options)
    model = b.finalize(device="cpu")
    sim = wf.Simulation(model, dt=0.02, solver=wf.NewtonPCG(tol=1e-10), record=False)
    sim.step(600)  # what is left of the motion falls tenfold in 62 steps
    term = model.terms.find(Contact)
    gap, force = term.at_points(sim.state)
    area = term.tables.host[0].area.ravel()
    used = area > 0.0
    return force[0, used, 2] / area[used], -gap[0, used], force[0, :, 2].sum()


FAMILIES = {name: lambda b, m, name=name: solid(b, name, m) for name in ("T4", "T10", "ENMC", "FN", "FN18", "H3843")}
for integration in ("tied", "full"):
    FAMILIES[f"3443, {integration}"] = lambda b, m, how=integration: plate(b, m, how)
for integration in ("tied", "split", "full"):
    FAMILIES[f"3243, {integration}"] = lambda b, m, how=integration: bar(b, m, how)


@pytest.mark.parametrize("family", FAMILIES)
def test_uniform_pressure_on_a_flat_collider(family):
    pressure, _, _ = pressed(FAMILIES[family])
    assert np.ptp(pressure) < 1e-8 * pressure.mean()


def test_total_stiffness_does_not_depend_on_the_mesh():
    totals = []
    for cells in ((2, 2, 1), (4, 4, 2), (6, 6, 3)):
        _, depth, force = pressed(lambda b, m, cells=cells: solid(b, "T4", m, cells))
        totals.append(force / depth.mean())
    assert np.ptp(totals) < 0.01 * totals[0]


@pytest.mark.parametrize("integration", ["full", "tied"])
def test_shells_are_uniform_without_contact(integration):
    """Between two equal loads the thickness of a plate of nu = 0.3 changes by the same at each node."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = plate(b, wf.SVK(E=1e6, nu=0.3, density=1000.0), integration)
    for sign in (1, -1):
        b.add_traction(flat_side(body, sign), (0, 0, sign * LOAD))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=0.02, solver=wf.NewtonPCG(tol=1e-10), record=False)
    sim.step(400)
    z = sim.state.displacement.numpy()[0, :, 2]
    stretch = z[np.abs(z) > 0.5 * np.abs(z).max()]  # of the gradients across the plate
    assert np.ptp(stretch) < 1e-8 * np.abs(stretch).mean()


def carried(turn, depth, cells):
    """Force on a cube of 0.1 m, N, turned by `turn`, at a depth, over its stiffness per area, N/m^3."""
    b = wf.ModelBuilder()
    mesh = wf.mesh.box((0.1, 0.1, 0.1), cells=(cells,) * 3, element="T4", map=lambda X: X @ np.array(turn).T)
    body = b.add_solid(mesh, material=STIFF)
    contact = b.add_contact(body, b.add_collider(wf.HalfSpace((0, 0, 1))))
    model = b.finalize(device="cpu")
    state = model.state()
    u = state.displacement.numpy()
    u[:, :, 2] = -depth - mesh.points[:, 2].min()
    state.displacement.assign(u)
    term = model.terms.find(Contact)
    _, force = term.at_points(state)
    assert np.abs(force[0, :, :2]).max() == 0.0
    return force[0, :, 2].sum() * term.tables.host[0].area.sum() / law_numbers(contact)["normal"]


def test_a_corner_and_an_edge_carry_what_their_area_says():
    r, s, t = 1 / math.sqrt(2), 1 / math.sqrt(3), 1 / math.sqrt(6)
    depth = 0.03
    corner = carried([[r, -r, 0.0], [t, t, -2.0 * t], [s, s, s]], depth, 16)
    assert corner == pytest.approx(1.5 * depth**3, rel=0.02)
    edge = carried([[r, -r, 0.0], [0.0, 0.0, -1.0], [r, r, 0.0]], depth, 16)
    ends = 2.0 * depth**3 / 3.0  # two triangles of area d^2 with a mean depth of d/3
    assert edge == pytest.approx(math.sqrt(2.0) * 0.1 * depth**2 + ends, rel=0.02)
