"""ANCF families: tangent and energy, patch tests, free fall."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from ancf_bodies import SVK, TURN, placed, rotation, state_of
from ancf_shapes import INTEGRATIONS, SHAPES, SPLIT, affine, beam, build, difference, lifted, shell, skew

import warpfea as wf

GRAVITY = np.array([1.0, -2.0, -9.81])
ONE_EACH = [c for c in SPLIT if c[0] in ("beam arc", "shell distorted")]
ONE_EACH += [("ENMC curved", None), ("FN", None), ("FN18", None), ("H3843 distorted", None)]


# tangent and energy


def strained(body, seed=0):
    """Displacements of a large strain and rotation, with J well above 0."""
    A = TURN @ (np.eye(3) + np.array([[0.1, 0.3, -0.1], [0.05, -0.2, 0.1], [-0.1, 0.2, 0.25]]))
    noise = np.random.default_rng(seed).uniform(-1, 1, body.reference.shape)
    return affine(body, A) + np.where(body.slot_kind == 0, 0.004, 0.05)[:, None] * noise


@pytest.mark.parametrize(("name", "integration"), ONE_EACH)
def test_tangent_and_force_are_derivatives(name, integration, data):
    body, model = build(name, integration, n=2)
    u, d = strained(body), np.random.default_rng(5).uniform(-1, 1, body.reference.shape)
    d[body.slot_kind == 0] *= 0.1
    state = state_of(model, u)
    assert 0.3 < model.evaluation.minimum_jacobian(state)[0] < 2.0
    force = model.internal_force(state)[0]
    K = model.tangent_matrix(state)
    assert abs(K - K.T).max() < 1e-14 * abs(K).max()
    numeric = difference(lambda t: model.internal_force(state_of(model, u + t * d))[0], 1e-3)
    assert data.error((K @ d.ravel()).reshape(-1, 3), numeric) < 1e-9
    numeric = difference(lambda t: model.strain_energy(state_of(model, u + t * d))[0], 1e-3)
    assert data.error(np.sum(force * d), numeric) < 1e-9
    _, single = build(name, integration, n=2, dtype="float32")
    state = state_of(single, u)
    assert data.error(single.internal_force(state)[0], force) < 2e-5
    assert data.error(single.tangent_matrix(state).toarray(), K.toarray()) < 2e-5


# patch tests


def stretch_of(E):
    """Symmetric A with A^T A = I + 2 E."""
    values, vectors = np.linalg.eigh(np.eye(3) + 2 * np.array(E))
    return vectors * np.sqrt(values) @ vectors.T


def symmetric(xx, yy, zz, yz, xz, xy):
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


THIN = -0.3 / 0.7 * (0.06 + 0.14)  # no stress across a shell
STATES = {
    "shell": {  # x, y along the surface
        "plane stress": symmetric(0.06, 0.14, THIN, 0, 0, 0.08),
        "transverse shear": symmetric(0.06, 0.14, THIN, 0.03, -0.05, 0.08),
        "pressed": symmetric(0.06, 0.14, -0.05, 0, 0, 0.08),
    },
    "beam": {  # x along the axis
        "tension": symmetric(0.1, -0.03, -0.03, 0, 0, 0),
        "transverse shear": symmetric(0.1, -0.03, -0.03, 0, 0.02, -0.03),
        "pressed": symmetric(0.1, -0.05, 0.02, 0.03, 0, 0),
    },
}


def plate_mesh(kind):
    if kind == "parallelograms":
        return wf.mesh.grid((1, 1), cells=(3, 3), map=lambda X: placed(skew(X)))
    mesh = lifted(wf.mesh.grid((1, 1), cells=(3, 3)), amount=0.25, plane=True)
    return replace(mesh, points=placed(mesh.points))


def solid_mesh(element):
    if element == "H3843":
        return lifted(wf.mesh.box((1, 0.8, 0.8), cells=(3, 2, 2), element=element), amount=0.25)
    return lifted(wf.mesh.box((1, 0.8, 0.8), cells=(3, 2, 2), element="T4"), amount=0.25)


def patch(b, body, E, outer, sides=()):
    """Outer nodes held at e = A E, inner ones started elsewhere: error of the solution over the largest displacement.

    E in the axes of the first node. Sides that no node holds get the traction P N of the constant stress; "tied" has
    5/6 of the transverse shear.
    """
    Q = np.eye(3) if body.node_axes is None else body.node_axes[0]
    A = rotation(40.0) @ Q @ stretch_of(E) @ Q.T
    b.clamp(body.nodes(outer))
    lam, mu = SVK.lame
    S = lam * np.trace(E) * np.eye(3) + 2 * mu * E
    if body.rule == "tied":
        normal = {"3243": [1.0, 0.0, 0.0], "3443": [0.0, 0.0, 1.0]}[body.family.name]  # of the section, of the surface
        S = np.where(np.subtract.outer(normal, normal) != 0, 5 / 6 * S, S)
    for name, normal in sides:
        b.add_traction(body.surface(name), A @ Q @ S @ normal)
    model = b.finalize(device="cpu")
    exact = affine(body, A)
    free = model.free_slots[:, 0]
    assert free.sum() >= 8
    noise = np.random.default_rng(2).uniform(-1, 1, exact.shape)
    state = state_of(model, exact + free[:, None] * np.where(body.slot_kind == 0, 0.0005, 0.005)[:, None] * noise)
    result = wf.solve_static(model, load_steps=1, tol=1e-13, state=state)
    return np.abs(result.state.displacement.numpy()[0] - exact).max() / np.abs(exact).max()


def outer_nodes(mesh):
    rows = mesh.boundary()
    return np.unique(mesh.cells[rows[:, 0, None], mesh.kind.faces[rows[:, 1]]])


@pytest.mark.parametrize("integration", INTEGRATIONS["shell"])
@pytest.mark.parametrize("state", STATES["shell"])
@pytest.mark.parametrize("kind", ["parallelograms", "quads"])
def test_patch_of_shells(kind, state, integration):
    """Exact with no stress across, with a pressure of 0.1 E on both faces, and with transverse shear on parallelograms.

    "tied" interpolates covariant shears: transverse shear on other quads comes out with errors in the gradients of the
    size of the strain, measured here.
    """
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_shell(plate_mesh(kind), thickness=0.1, material=SVK, integration=integration)
    ez = np.array([0.0, 0.0, 1.0])
    error = patch(b, body, STATES["shell"][state], outer_nodes(body.mesh), [("top", ez), ("bottom", -ez)])
    measured = {"quads transverse shear": 0.045}
    assert error < (measured.get(f"{kind} {state}", 1e-9) if integration == "tied" else 1e-9)


@pytest.mark.parametrize("integration", INTEGRATIONS["beam"])
@pytest.mark.parametrize("state", STATES["beam"])
@pytest.mark.parametrize("curve", ["straight", "uneven"])
def test_patch_of_beams(curve, state, integration):
    """Exact in tension. "tied" takes the section's strains and the shear at the nodes: tractions on the sides, a moment
    or a pressure along the beam, come out with errors in the gradients, measured here."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = SHAPES[f"beam {curve}"](b, 4, integration=integration)
    _, y, z = np.eye(3)
    sides = [("side-", -y), ("side+", y), ("normal-", -z), ("normal+", z)]
    error = patch(b, body, STATES["beam"][state], [0, 4], sides)
    measured = {"transverse shear": 0.25, "pressed": 0.15}
    assert error < (measured.get(state, 1e-9) if integration == "tied" else 1e-9)


@pytest.mark.parametrize(
    ("element", "rule"),
    [("ENMC", None), ("ENMC", "conical4"), ("FN", None), ("FN18", None), ("H3843", "3x3x3"), ("H3843", "4x4x4")],
)
def test_patch_of_solids(element, rule):
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_solid(solid_mesh(element), material=SVK, element=element, quadrature=rule)
    assert patch(b, body, symmetric(0.1, -0.15, 0.2, 0.05, -0.1, 0.15), outer_nodes(body.mesh)) < 1e-9


# free fall


@wp.func
def uniform_field(x: wp.vec3d, t: wp.float64) -> wp.vec3d:
    return wp.vec3d(wp.float64(1.0) + t, wp.float64(-2.0), wp.float64(3.0) * wp.sin(t))


def fall(load, h, steps):
    u, v = np.zeros(3), np.zeros(3)
    for k in range(1, steps + 1):
        t = k * h
        v = v + h * (GRAVITY if load == "gravity" else np.array([1.0 + t, -2.0, 3.0 * np.sin(t)]))
        u = u + h * v
    return u


def fall_error(sim, bodies, exact):
    u = sim.state.displacement.numpy()[0]
    kind = sim.model.slot_table.kind[:, None]
    rows = np.concatenate([body.slots for body in bodies])
    return np.abs(u - np.where(kind == 0, exact, 0.0))[rows].max() / np.abs(exact).max()


@pytest.mark.parametrize("dtype", ["float64", pytest.param("float32", marks=pytest.mark.slow)])
@pytest.mark.parametrize(("name", "integration"), ONE_EACH)
def test_free_fall_is_exact(name, integration, dtype):
    bound = 1e-12 if dtype == "float64" else 1e-5
    for load in ("gravity", "field"):
        b = wf.ModelBuilder(gravity=GRAVITY if load == "gravity" else (0, 0, 0))
        body = SHAPES[name](b, 2, **({"integration": integration} if integration else {}))
        if load == "field":
            b.add_body_force(uniform_field)
        model = b.finalize(device="cpu", dtype=dtype)
        for cap in (1, 50):
            sim = wf.Simulation(model, dt=1.0, solver=wf.NewtonPCG(max_newton=cap, max_pcg=cap, max_halvings=0))
            for h in (1e-5, 1e-3, 0.1):
                sim.reset()
                sim.dt = h
                sim.step(8)
                assert fall_error(sim, [body], fall(load, h, 8)) < bound, (load, cap, h)


@pytest.mark.parametrize("dtype", ["float64", pytest.param("float32", marks=pytest.mark.slow)])
def test_free_fall_of_all_families_beside_held_ones(dtype):
    """All in one model, with a clamped beam and a driven shell, which do not feel the others."""
    b = wf.ModelBuilder(gravity=GRAVITY)
    bodies = []
    for name, integration in ONE_EACH:
        options = {"integration": integration} if integration else {}
        bodies.append(SHAPES[name](b, 2, **options, name=f"{name} {integration}"))
    bodies.append(b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1)), material=SVK, name="T10"))
    held = beam([(0, 0, 0), (1, 0, 0)])(b, 2, name="held")
    b.clamp(held.start)
    driven = shell()(b, 2, name="driven")
    b.drive(driven.edge("x-"), rotation=wf.Rotation((0, 0, 0), (0, 1, 0), ([0, 1], [0, 3])), slots="all")
    sim = wf.Simulation(b.finalize(device="cpu", dtype=dtype), dt=1e-3)
    sim.step(10)
    assert fall_error(sim, bodies, fall("gravity", 1e-3, 10)) < (1e-12 if dtype == "float64" else 1e-5)
    edge = sim.displacements(driven)[0, driven.edge("x-").indices]
    assert np.abs(edge).max() < 1e-9
    free = sim.displacements(held)[0, held.end.indices[0]]
    assert 0 < np.abs(free).max() < 2 * np.abs(fall("gravity", 1e-3, 10)).max()
