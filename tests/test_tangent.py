"""The tangent against differences of the force, its product, and Kelvin-Voigt damping under finite rotations."""

from __future__ import annotations

import math

import numpy as np
import pytest
import warp as wp
from element_meshes import rotation
from warpfea.kernels.elements.element_slots import iterate_struct
from warpfea.kernels.elements.with_mass import with_mass_kernel

import warpfea as wf
from warpfea.mesh.cells import TET_EDGES
from warpfea.solvers.clusters import make_cluster_memory, make_clusters

RHO = 1000.0
LAWS = {
    "svk": {"make": wf.SVK, "E": 1e6, "nu": 0.3},
    "mooney_rivlin": {"make": wf.MooneyRivlin, "mu10": 3e5, "mu01": 1e5, "k": 1e6},
    "neo_hookean": {"make": wf.NeoHookean, "mu": 4e5, "k": 1e6},
}
MESHES = {
    "T4": lambda: wf.mesh.box((1, 1, 1), cells=(2, 2, 1), element="T4"),
    "T10": lambda: wf.mesh.box((1, 1, 1), cells=(2, 1, 1)),
    "sphere": lambda: wf.mesh.sphere(0.7, cells=2),
}
AFFINE = np.array([[0.1, 0.3, -0.1], [0.05, -0.2, 0.1], [-0.1, 0.2, 0.25]])


def law(name, **options):
    values = dict(LAWS[name])
    return values.pop("make")(**values, density=RHO, **options)


def make(name, material, **options):
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    rule = "tet14" if name == "sphere" else None
    body = b.add_solid(MESHES[name](), material=material, quadrature=rule)
    return b, body, b.finalize(device="cpu", **options)


def state_of(model, u, v=None):
    state = model.state()
    state.displacement.assign(u[None])
    if v is not None:
        state.velocity.assign(v[None])
    return state


def deformed(body, seed=0):
    """Displacements of a large strain, with J well above 0."""
    rng = np.random.default_rng(seed)
    return body.reference @ AFFINE.T + 0.02 * rng.uniform(-1, 1, body.reference.shape)


def difference(f, h):
    """Derivative at 0 by central differences with an error of O(h^6)."""
    one, two, three = ((f(k * h) - f(-k * h)) / (60 * h) for k in (1, 2, 3))
    return 45 * one - 9 * two + three


@pytest.mark.parametrize("material", LAWS)
@pytest.mark.parametrize("name", MESHES)
def test_tangent_is_the_derivative_of_the_force(name, material, data):
    _, body, model = make(name, law(material))
    u = deformed(body)
    state = state_of(model, u)
    assert 0.1 < model.evaluation.minimum_jacobian(state)[0] < 2.0
    K = model.tangent_matrix(state)
    assert abs(K - K.T).max() < 1e-14 * abs(K).max()
    for seed in range(3):
        d = np.random.default_rng(seed).uniform(-1, 1, u.shape)
        numeric = difference(lambda t: model.internal_force(state_of(model, u + t * d))[0], 3e-4)  # noqa: B023
        assert data.error((K @ d.ravel()).reshape(-1, 3), numeric) < 1e-9


@pytest.mark.parametrize("material", LAWS)
def test_force_is_the_derivative_of_the_energy(material, data):
    _, body, model = make("T10", law(material))
    u = deformed(body)
    d = np.random.default_rng(5).uniform(-1, 1, u.shape)
    numeric = difference(lambda t: model.strain_energy(state_of(model, u + t * d))[0], 3e-4)
    assert data.error(numeric, np.sum(model.internal_force(state_of(model, u))[0] * d)) < 1e-10


def test_tangent_of_each_world_is_its_own():
    _, body, model = make("T10", law("svk"), worlds=2)
    u = np.stack([0 * body.reference, deformed(body)])
    state = model.state()
    state.displacement.assign(u)
    alone = make("T10", law("svk"))[2]
    for world in range(2):
        K = model.tangent_matrix(state, world=world)
        expected = alone.tangent_matrix(state_of(alone, u[world]))
        assert abs(K - expected).max() == 0
        force = alone.internal_force(state_of(alone, u[world]))[0]
        np.testing.assert_array_equal(model.internal_force(state)[world], force)


# the product of straight T10: from differences of slots at the vertices, or from all slots at each point


def straight_and_distorted():
    """T10 of many shapes with straight sides."""
    mesh = wf.mesh.box((1, 1, 1), cells=(2, 2, 1))
    points, corners = mesh.points.copy(), np.unique(mesh.cells[:, :4])
    points[corners] += np.random.default_rng(7).uniform(-0.1, 0.1, (len(corners), 3))
    a, b = TET_EDGES.T
    points[mesh.cells[:, 4:]] = (points[mesh.cells[:, a]] + points[mesh.cells[:, b]]) / 2
    return wf.mesh.Mesh(points, mesh.cells, "tetra10")


def straight_model(material, form, dtype, rule):
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    damping = wf.KelvinVoigt(2e4, 3e4, form=form) if form else None
    body = b.add_solid(straight_and_distorted(), material=law(material, damping=damping), quadrature=rule)
    return body, b.finalize(device="cpu", dtype=dtype, worlds=2)


def fields_of(model, u, v, p, mass_factor):
    """Arguments on the device for fields [world, slot] of two worlds with their own factors and random histories:
    iterate, c_M, flags, p."""
    rng, n = np.random.default_rng(3), max(1, model.history_count)
    u, v, p = (wp.array(x.astype(model.dtype), dtype=model.types.vec3, device="cpu") for x in (u, v, p))
    past = 0.1 * rng.uniform(-1, 1, (2, n, 6)).astype(model.dtype)
    at = iterate_struct(model.dtype)()
    at.u, at.v, at.history = u, v, wp.array(past, dtype=model.types.sym, device="cpu")
    mass, at.dq_dv = (wp.array([x, 2 * x], dtype=wp.float64, device="cpu") for x in (mass_factor, 1e-3))
    return at, mass, wp.ones(2, dtype=wp.int32, device="cpu"), p


def with_mass_product(model, kernel, u, v, p, mass_factor=1e3):
    """Sums [world, slot] of what the clusters give in both worlds."""
    (block,) = model.blocks
    clusters = make_clusters(model)
    ((data, count),) = clusters.blocks
    sim = wf.Simulation(model, dt=1e-3, solver=wf.NewtonPCG(operator="elements"))
    out = wp.zeros((2, clusters.sums), dtype=model.types.vec3, device="cpu")
    args = [block.data, data, *fields_of(model, u, v, p, mass_factor), 1]
    args += [make_cluster_memory(model, sim.stepper.work, midpoint=False), out]
    wp.launch(kernel, dim=(2, count), inputs=args, device="cpu")
    total = np.zeros((2, model.slots, 3))
    slot = np.repeat(np.arange(model.slots), np.diff(clusters.topology.contribution_start.numpy()))
    np.add.at(total, (slice(None), slot), out.numpy().astype(float)[:, clusters.topology.contribution_entry.numpy()])
    return total


def separate_product(model, u, v, p, mass_factor):
    """The same from the stiffness of elements that read their slots themselves, and the model's mass."""
    (block,) = model.blocks
    at, mass, on, p = fields_of(model, u, v, p, mass_factor)
    out = wp.zeros((2, model.contributions), dtype=model.types.vec3, device="cpu")
    args = [block.data, at, on, p, out]
    wp.launch(block.kernels.tangent_product, dim=(2, block.count), inputs=args, device="cpu")
    force = out.numpy().astype(float)
    total = np.stack([m * (model.masses.matrix @ x) for m, x in zip(mass.numpy(), p.numpy().astype(float))])
    np.add.at(total, (slice(None), block.data.conn.numpy().ravel()), at.dq_dv.numpy()[:, None, None] * force)
    return total


def slow(*case):
    """A case with kernels that no other fast test needs."""
    return pytest.param(*case, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    ("material", "form", "dtype", "rule"),
    [
        ("svk", None, "float64", "tet4"),
        ("svk", None, "float32", "tet4"),
        slow("svk", "incremental", "float64", "tet5_paper"),
        slow("svk", "rate", "float64", "tet4"),
        ("mooney_rivlin", None, "float64", "tet5_paper"),
        slow("mooney_rivlin", "rate", "float32", "tet5_paper"),
        ("neo_hookean", "incremental", "float64", "tet4"),
        slow("neo_hookean", None, "float32", "tet4"),
    ],
)
def test_both_forms_of_the_product_agree(material, form, dtype, rule, data):
    body, model = straight_model(material, form, dtype, rule)
    (block,) = model.blocks
    assert block.key.vertex
    general = with_mass_kernel(dtype, material, 10, block.points, form, False, block.cluster_size)
    kernels = [general, block.with_mass_product(dtype, form)]
    u = np.stack([deformed(body), deformed(body, seed=1)])
    v, p = np.random.default_rng(2).uniform(-1, 1, (2, *u.shape))
    for mass_factor in (0.0, 1e3):  # 1e3: mass and stiffness are of one size
        expected = separate_product(model, u, v, p, mass_factor)
        for kernel in kernels:
            got = with_mass_product(model, kernel, u, v, p, mass_factor)
            for world in range(2):
                assert data.error(got[world], expected[world]) < (1e-13 if dtype == "float64" else 1e-5)


def test_the_size_of_clusters_changes_nothing(data):
    body, model = straight_model("svk", None, "float64", "tet4")
    (block,) = model.blocks
    u, v, p = np.random.default_rng(2).uniform(-0.1, 0.1, (3, 2, *body.reference.shape))
    expected = with_mass_product(model, block.with_mass_product("float64", None), u, v, p)
    block.cluster_size = 32
    got = with_mass_product(model, block.with_mass_product("float64", None), u, v, p)
    assert data.error(got, expected) < 1e-14


def test_a_translation_strains_no_straight_element():
    body, model = straight_model("svk", None, "float64", "tet4")
    (block,) = model.blocks
    shape = (2, *body.reference.shape)
    u, far = np.zeros(shape), np.broadcast_to([1e6 / 3, -1e5 / 7, 1e3 / 11], shape)
    p = np.random.default_rng(2).uniform(-1, 1, shape)
    kernel = block.with_mass_product("float64", None)
    assert np.all(with_mass_product(model, kernel, p, u, far, 0.0) == 0.0)
    at_rest = with_mass_product(model, kernel, u, u, p)
    np.testing.assert_array_equal(with_mass_product(model, kernel, far, u, p), at_rest)


@pytest.mark.parametrize(
    ("rule", "expected"), [("tet4", True), ("tet5_paper", True), ("tet8", False), ("tet14", False)]
)
def test_which_straight_elements_take_the_form_of_vertices(rule, expected):
    _, model = straight_model("svk", None, "float64", rule)
    assert model.blocks[0].key.affine
    assert model.blocks[0].key.vertex == expected


def test_other_elements_keep_the_general_product():
    for name in ("T4", "sphere"):
        for block in make(name, law("svk"))[2].blocks:
            assert not block.key.vertex


# damping


def damped(form, eta=2e4, lambda_v=3e4):
    return law("svk", damping=wf.KelvinVoigt(eta, lambda_v, form=form))


def step_force(model, block, u0, u1, h):
    """Elastic plus viscous force contributions of a backward Euler step from u0 to u1, and the viscous potential."""
    before, after = state_of(model, u0), state_of(model, u1, (u1 - u0) / h)
    history = wp.zeros((1, model.history_count), dtype=model.types.sym, device="cpu")
    on = wp.ones(1, dtype=wp.int32, device="cpu")
    one, none, dq = (wp.array([x], dtype=wp.float64, device="cpu") for x in (1.0, 0.0, h))
    old = before.displacement
    args = [block.data, old, old, one, none, on, history]
    wp.launch(block.kernels.strain_history, dim=(1, block.count), inputs=args, device="cpu")
    contribution = wp.zeros((1, model.contributions), dtype=model.types.vec3, device="cpu")
    energy = wp.zeros((2, 1, model.element_count), dtype=wp.float64, device="cpu")
    low = wp.full(1, 1e30, dtype=wp.float64, device="cpu")
    iterate = iterate_struct("float64")()
    iterate.u, iterate.v, iterate.history, iterate.dq_dv = after.displacement, after.velocity, history, dq
    args = [block.data, iterate, on, 1, contribution, energy, low, wp.clone(low)]
    wp.launch(block.kernels.internal_force, dim=(1, block.count), inputs=args, device="cpu")
    rows = contribution.numpy()[0].reshape(block.slots, block.count, 3)
    force = np.zeros((model.slots, 3))
    np.add.at(force, block.host_blocks[0].conn.T, rows)
    return force, energy.numpy()[1].sum()


@pytest.mark.parametrize("angle", [5.0, 40.0, 120.0, 180.0])
def test_incremental_damping_ignores_a_rotation_of_a_strained_body(angle, data):
    """From a strained state to the same state turned and moved in one step: Edot = 0 to round-off."""
    _, body, model = make("T10", damped("incremental"))
    (block,) = model.blocks
    u0 = deformed(body)
    u1 = (body.reference + u0) @ rotation(angle).T - body.reference + np.array([1.0, 2.0, 3.0])
    force, potential = step_force(model, block, u0, u1, 1e-2)
    elastic = model.internal_force(state_of(model, u1))[0]
    strained, work = step_force(model, block, 0 * u0, u0, 1e-2)
    viscous = np.abs(strained - model.internal_force(state_of(model, u0))[0]).max()
    assert viscous > np.abs(elastic).max()
    assert np.abs(force - elastic).max() < 1e-12 * viscous
    assert 0 <= potential < 1e-24 * work


def test_incremental_damping_has_a_potential(data):
    """Its force is the gradient of psi + psi_v (times h), so that its tangent is symmetric."""
    _, body, model = make("T10", damped("incremental"))
    (block,) = model.blocks
    u0, u1, h = deformed(body), deformed(body, seed=1) @ rotation(30).T, 1e-2
    d = np.random.default_rng(2).uniform(-1, 1, u0.shape)
    force, _ = step_force(model, block, u0, u1, h)
    viscous = force - model.internal_force(state_of(model, u1))[0]
    numeric = difference(lambda t: step_force(model, block, u0, u1 + t * d, h)[1], 3e-4)
    assert data.error(numeric, np.sum(viscous * d)) < 1e-9


def one_turning_step(form, angle, h=1e-2):
    """A free body whose velocity carries it into a rotated place within a step; displacements and their exact value."""
    b, body, _ = make("T10", damped(form))
    X = body.mesh.points - body.origin
    turned = X @ (rotation(angle) - np.eye(3)).T
    b.set_initial(body, velocity=turned / h)
    model = b.finalize(device="cpu")
    sim = wf.Simulation(model, dt=h, solver=wf.NewtonPCG(tol=1e-10, max_newton=60))
    report = sim.step()
    assert report.converged.all()
    return sim, body, sim.displacements(body)[0], turned


@pytest.mark.parametrize("angle", [5.0, 40.0, 120.0, 180.0])
def test_a_damped_body_turns_by_any_angle_in_a_step(angle, data):
    """q_n + h v_n is the rotated body: equilibrium without a single iteration, if damping does not see rotations."""
    sim, _, u, turned = one_turning_step("incremental", angle)
    assert data.error(u, turned) < 1e-13
    assert sim.last.halvings[0] == 0
    assert np.abs(sim.energies()["viscous"]).max() < 1e-20 * sim.energies()["kinetic"][0]


def test_rate_damping_swells_a_turning_body(data):
    """Purpose of the incremental form: Eq. (58) with F and Fdot at the end of the step strains the body."""
    _, body, u, turned = one_turning_step("rate", 40.0)
    assert data.error(u, turned) > 1e-2
    x, X = body.mesh.points + u, body.mesh.points
    sizes = [np.linalg.norm(p - p.mean(axis=0), axis=1).sum() for p in (x, X)]
    assert abs(sizes[0] / sizes[1] - 1) > 1e-3


@pytest.mark.parametrize("integrator", ["backward_euler", "bdf2"])
def test_a_spinning_damped_body_keeps_its_shape(integrator):
    """More than a turn in steps of up to 20 degrees; centrifugal strain is below 1e-5, damping far above elasticity."""
    stiff = wf.SVK(E=1e8, nu=0.3, density=1.0, damping=wf.KelvinVoigt(1e7, 1e7))
    b, body, _ = make("T10", stiff)
    b.set_initial(body, angular_velocity=(10.0, 20.0, -20.0))
    model = b.finalize(device="cpu")
    sim = wf.Simulation(model, dt=0.012, integrator=integrator)
    X = body.mesh.points
    distances = lambda p: np.linalg.norm(p[:, None] - p[None], axis=2)  # noqa: E731
    worst, turned, before = 0.0, 0.0, X
    for _ in range(50):
        sim.step()
        x = sim.positions(body)[0]
        worst = max(worst, np.abs(distances(x) - distances(X)).max())
        a, _, c = np.linalg.svd((x - x.mean(0)).T @ (before - before.mean(0)))
        R = a @ np.diag([1, 1, np.linalg.det(a @ c)]) @ c
        turned += math.degrees(math.acos(min(1.0, (np.trace(R) - 1) / 2)))
        before = x
    assert turned > 360
    assert worst < 1e-5
