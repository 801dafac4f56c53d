"""Loads and prescribed motion against closed forms and an independent quadrature."""

import numpy as np
import pytest
import warp as wp

import warpfea as wf

STIFF = wf.SVK(E=1e7, nu=0.3, density=1000.0)


def one(mesh=None, material=STIFF, gravity=(0, 0, 0)):
    b = wf.ModelBuilder(gravity=gravity)
    return b, b.add_solid(mesh or wf.mesh.box((1, 0.5, 0.25), cells=(3, 2, 1)), material=material)


def loads_of(b, steps=1, dt=1e-3):
    """Total force on the free body from its momentum after a step: sum of loads, whatever their distribution."""
    model = b.finalize(device="cpu")
    sim = wf.Simulation(model, dt=dt)
    sim.step(steps)
    return model.masses.lumped[0] @ sim.state.velocity.numpy()[0] / (dt * steps), sim


def test_traction_is_force_per_area():
    b, body = one()
    b.add_traction(body.surface("x+"), (3.0, -2.0, 8.0))
    total, _ = loads_of(b)
    assert total == pytest.approx(np.array([3.0, -2.0, 8.0]) * 0.125, rel=1e-10)


def test_traction_weights_of_straight_faces():
    """Consistent load of a straight six-node triangle: nothing at the corners, a third at each mid-side."""
    b, body = one()
    b.add_traction(body.surface("x+"), (1.0, 0.0, 0.0))
    load = b.description.dead_loads[0]
    corners = np.unique(body.mesh.cells[:, :4])
    is_corner = np.isin(body.slot_node[load.slots], corners)
    assert np.abs(load.weights[is_corner]).max() < 1e-15
    assert load.weights[~is_corner].min() > 0.0


def test_point_load_at_any_material_point():
    b, body = one()
    X = np.array([0.37, 0.21, 0.11])
    point = body.at(X)
    positions = body.reference[point.slots] + body.origin
    assert point.weights @ positions == pytest.approx(X, rel=1e-12)
    assert point.weights.sum() == pytest.approx(1.0, rel=1e-14)
    b.add_point_load(point, ([0.0, 1e-3, 1.0], [(0, 0, 0), (5.0, 1.0, -2.0), (5.0, 1.0, -2.0)]))
    total, sim = loads_of(b)
    assert total == pytest.approx([5.0, 1.0, -2.0], rel=1e-9)
    work = sim.energies()["work_loads"][0]
    assert work == pytest.approx(
        np.array([5.0, 1.0, -2.0]) @ (point.weights @ sim.state.displacement.numpy()[0][point.slots])
    )


def test_point_outside_is_refused():
    b, body = one()
    with pytest.raises(wf.ModelError, match=r"point \[2.0, 0.0, 0.0\] lies outside"):
        body.at((2.0, 0, 0))


def test_point_in_a_curved_body():
    b, body = one(wf.mesh.sphere(0.5, cells=4))
    X = np.array([0.1, 0.2, 0.35])
    point = body.at(X)
    assert point.weights @ (body.reference[point.slots] + body.origin) == pytest.approx(X, abs=1e-9)


@wp.func
def moving_field(x: wp.vec3d, t: wp.float64) -> wp.vec3d:
    return wp.vec3d(x[1] * x[1], wp.float64(2.0) * x[0] + t, x[2])


def test_body_force_is_taken_at_the_current_position():
    """Eq. (23) against an independent high-order quadrature at the displaced position and new time."""
    from warpfea.elements.quadrature import conical_tet

    b, body = one()
    shift = np.array([0.3, -0.2, 0.7])
    b.set_initial(body, displacement=lambda X: np.broadcast_to(shift, X.shape))
    b.add_body_force(moving_field)
    dt = 1e-7  # so short that the body does not move
    total, _ = loads_of(b, dt=dt)
    rule = conical_tet(5)
    nodes = body.mesh.points[body.mesh.cells[:, :4]]
    s = np.column_stack([1 - rule.points.sum(axis=1), rule.points])
    x = np.einsum("qi,eik->eqk", s, nodes) + shift
    volume = np.abs(np.linalg.det(nodes[:, 1:] - nodes[:, :1]))
    w = 1000.0 * volume[:, None] * rule.weights
    field = np.stack([x[..., 1] ** 2, 2 * x[..., 0] + dt, x[..., 2]], axis=-1)
    assert total == pytest.approx(np.einsum("eq,eqk->k", w, field), rel=1e-7)


def test_follower_pressure_turns_with_the_body():
    """A closed surface under uniform pressure has no resultant, wherever and however it is turned and stretched."""
    mesh = wf.mesh.sphere(0.5, cells=4)
    b, body = one(mesh)
    angle = 0.7
    R = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    b.set_initial(body, displacement=lambda X: X @ (R * 1.2).T + 3.0 - X)
    b.add_pressure(body.surface("surface"), 1e3)
    model = b.finalize(device="cpu")
    sim = wf.Simulation(model, dt=1e-6)
    sim.step()
    force = sim.stepper.work.nonpotential.numpy()[0]
    area = 4 * np.pi * 0.6**2
    assert np.abs(force.sum(axis=0)).max() < 1e-12 * 1e3 * area
    # virtual work of a uniform growth: p dV
    x = sim.positions(body)[0] - 3.0
    assert np.sum(force * x[body.slot_node]) == pytest.approx(-1e3 * 3 * mesh.volume() * 1.2**3, rel=1e-5)


def test_pressure_on_one_side_has_the_area_as_resultant():
    b, body = one()
    b.add_pressure(body.surface("z+"), ([0.0, 1.0], [2000.0, 2000.0]))
    total, _ = loads_of(b, dt=1e-8)  # so short that the surface keeps its shape
    assert total == pytest.approx([0.0, 0.0, -2000.0 * 0.5], abs=1e-6)


@wp.func
def pulse(t: wp.float64) -> wp.vec3d:
    return wp.vec3d(wp.sin(wp.float64(10.0) * t), wp.float64(0.0), wp.float64(1.0))


def test_law_as_a_function_of_time():
    b, body = one()
    b.add_traction(body.surface("x+"), pulse)
    total, _ = loads_of(b, dt=1e-2)
    assert total == pytest.approx(np.array([np.sin(0.1), 0.0, 1.0]) * 0.125, rel=1e-9)


def test_driven_nodes_follow_the_law_exactly():
    b, body = one()
    b.clamp(body.nodes("x-"), components="yz")
    times, path = [0.0, 0.01, 0.02], [(0, 0, 0), (0.01, 0.002, 0), (0.0, 0.01, -0.003)]
    b.drive(body.nodes("x+"), displacement=(times, path))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    moved = body.nodes("x+").indices
    for k in range(20):
        sim.step()
        expected = [np.interp((k + 1) * 1e-3, times, np.array(path)[:, c]) for c in range(3)]
        assert np.abs(sim.displacements(body)[0, moved] - expected).max() < 1e-14


@pytest.mark.parametrize("integrator", ["backward_euler", "bdf2", "generalized_alpha"])
def test_driven_rotation_goes_round(integrator):
    b, body = one(material=wf.SVK(E=1e5, nu=0.3, density=1000.0, damping=wf.KelvinVoigt(100.0)))
    anchor, axis = np.array([0, 0.25, 0.125]), np.array([1.0, 0, 0])
    b.drive(body.nodes("x-"), rotation=wf.Rotation(anchor=anchor, axis=2 * axis, angle=([0, 0.1], [0, 2.5 * np.pi])))
    # whirled so fast, so soft a body turns inside out
    sim = wf.Simulation(b.finalize(device="cpu"), dt=2e-3, integrator=integrator, inversion="report")
    sim.step(50)
    nodes = body.nodes("x-").indices
    arm = body.mesh.points[nodes] - anchor
    turned = np.column_stack([arm[:, 0], -arm[:, 2], arm[:, 1]])
    assert np.abs(sim.positions(body)[0, nodes] - anchor - turned).max() < 1e-13


def test_driven_table_per_node():
    b, body = one()
    nodes = body.nodes("x-")
    values = np.zeros((2, len(nodes), 3))
    values[1, :, 1] = np.linspace(0.0, 1e-3, len(nodes))
    b.drive(nodes, displacement=([0.0, 1e-2], values))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    sim.step(10)
    assert sim.displacements(body)[0, nodes.indices] == pytest.approx(values[1], abs=1e-16)


def test_reaction_balances_the_loads():
    b, body = one(gravity=(0, 0, -9.81))
    b.clamp(body.nodes("x-"))
    b.add_traction(body.surface("x+"), (100.0, 0.0, 0.0))
    b.add_probe("end", body.surface("x+"))
    model = b.finalize(device="cpu")
    static = wf.solve_static(model, load_steps=2, tol=1e-10)
    expected = -np.array([12.5, 0.0, -9.81 * 125.0])
    assert static.reaction(body.nodes("x-"))[0] == pytest.approx(expected, rel=1e-7, abs=1e-7)
    assert static.probe("end").displacement.shape == (1, 2, 3)
    assert static.probe("end").time == pytest.approx([0.5, 1.0])


def test_static_rollers_are_enough_support():
    b, body = one()
    for side, axis in (("x-", "x"), ("y-", "y"), ("z-", "z")):
        b.clamp(body.nodes(side), components=axis)
    b.drive(body.nodes("x+"), displacement=(0.1, 0, 0), components="x")
    static = wf.solve_static(b.finalize(device="cpu"), load_steps=2, tol=1e-11)
    u = static.displacements(body)[0]
    X = body.mesh.points
    fit = np.linalg.lstsq(np.column_stack([X, np.ones(len(X))]), u, rcond=None)[0]
    assert np.abs(np.column_stack([X, np.ones(len(X))]) @ fit - u).max() < 1e-10  # homogeneous
    assert fit[0, 0] == pytest.approx(0.1, rel=1e-10)


def test_density_of_position_and_per_element():
    mesh = wf.mesh.box((1, 0.5, 0.25), cells=(3, 2, 1))
    linear = wf.SVK(E=1e6, nu=0.3, density=lambda X: 1000.0 * (1.0 + X[:, 0]))
    b, _ = one(mesh, linear)
    assert b.finalize(device="cpu").info()["mass"] == pytest.approx(125.0 * 1.5, rel=1e-12)
    values = np.where(mesh.centroids()[:, 0] < 1 / 3, 500.0, 2000.0)
    b, _ = one(mesh, wf.SVK(E=1e6, nu=0.3, density=values))
    assert b.finalize(device="cpu").info()["mass"] == pytest.approx(0.125 * (500 + 2 * 2000) / 3, rel=1e-12)


def test_several_materials_in_one_body():
    """Two laws in series under a dead pull: each half stretches as its own stiffness says."""
    mesh = wf.mesh.box((2, 1, 1), cells=(2, 1, 1))
    left = np.flatnonzero(mesh.centroids()[:, 0] < 1.0)
    groups = {"hard": left, "soft": np.setdiff1d(np.arange(len(mesh.cells)), left)}
    mesh = wf.mesh.Mesh(mesh.points, mesh.cells, mesh.cell_type, mesh.node_sets, groups, mesh.surface_sets, "two")
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    laws = {"hard": wf.SVK(E=1e7, nu=0.0), "soft": wf.NeoHookean.from_E_nu(E=1e6, nu=0.0)}
    body = b.add_solid(mesh, material=laws)
    for side, axis in (("x-", "x"), ("y-", "y"), ("z-", "z")):
        b.clamp(body.nodes(side), components=axis)
    b.add_traction(body.surface("x+"), (1e3, 0, 0))
    static = wf.solve_static(b.finalize(device="cpu"), load_steps=1, tol=1e-11)
    u = static.displacements(body)[0, :, 0]
    X = body.mesh.points[:, 0]
    middle, end = u[np.isclose(X, 1.0)].mean(), u[np.isclose(X, 2.0)].mean()
    assert middle == pytest.approx(1e-4, rel=2e-3)
    assert end - middle == pytest.approx(1e-3, rel=5e-3)
