"""Rigid parts against closed forms and the equations of motion of rigid bodies, integrated by scipy."""

import itertools
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from scipy.special import ellipj, ellipk

import warpfea as wf
from warpfea.model.assembly import facet_areas, facet_positions, facet_tables

TIGHT = {"solver": wf.NewtonPCG(tol=1e-12), "constraint_tol": 1e-12}
INERTIA = np.array([1.0, 2.0, 3.0])


def free_part(inertia: Any = tuple(INERTIA), spin: Any = (0.01, 1.0, 0.01)) -> tuple[wf.Model, Any]:
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    part = b.add_rigid(wf.Box((0, 0, 0), (0.1, 0.2, 0.3)), mass=1.0, inertia=inertia, name="part")
    b.set_initial(part, angular_velocity=spin)
    return b.finalize(device="cpu"), part


def rotation(sim: wf.Simulation, part: Any) -> np.ndarray:
    """A (3, 3) of world 0."""
    x, y, z, w = sim.pose(part)[1][0]
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross


def momenta(model: wf.Model, sim: wf.Simulation) -> tuple[np.ndarray, float]:
    """Angular momentum about the origin, kg m^2/s, and kinetic energy, J, from the mass matrix."""
    M = model.masses.world_matrix(0).toarray()
    x = model.slot_table.reference + sim.state.displacement.numpy()[0]
    v = sim.state.velocity.numpy()[0]
    return np.cross(x, M @ v).sum(axis=0), 0.5 * float(np.sum(v * (M @ v)))


def rigid_body_motion(
    inertia: np.ndarray, A0: np.ndarray, spin: np.ndarray, torque: Any, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A (n, 3, 3) and body angular velocities (n, 3) of Euler's equations; torque(A) in the axes of the body."""

    def rate(_: float, y: np.ndarray) -> np.ndarray:
        A, w = y[:9].reshape(3, 3), y[9:]
        cross = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
        return np.concatenate([(A @ cross).ravel(), (torque(A) - np.cross(w, inertia * w)) / inertia])

    start = np.concatenate([A0.ravel(), spin])
    y = solve_ivp(rate, (0.0, times[-1]), start, "DOP853", times, rtol=1e-12, atol=1e-13).y.T
    return y[:, :9].reshape(-1, 3, 3), y[:, 9:]


@pytest.mark.slow
def test_torque_free_part_turns_over_with_its_period_and_keeps_energy_and_momentum() -> None:
    model, part = free_part()
    sim = wf.Simulation(model, dt=1e-2, integrator="energy_momentum", **TIGHT)
    L0, E0 = momenta(model, sim)
    times, first = [0.0], [0.01]
    for k in range(10_000):
        sim.step()
        times.append(1e-2 * (k + 1))
        first.append(float((rotation(sim, part).T @ sim.angular_velocity(part)[0])[0]))
    L, E = momenta(model, sim)
    assert np.linalg.norm(L - L0) < 1e-10 * np.linalg.norm(L0)
    assert abs(E - E0) < 1e-10 * E0
    w, t = np.array(first), np.array(times)
    change = np.flatnonzero(w[:-1] * w[1:] < 0.0)  # half a period apart
    zero = t[change] - w[change] * (t[change + 1] - t[change]) / (w[change + 1] - w[change])
    assert len(zero) == 6
    assert 2.0 * np.diff(zero)[1:].mean() == pytest.approx(39.1057, rel=1e-4)


def test_free_parts_follow_eulers_equations_with_second_order() -> None:
    spin = np.array([0.5, 1.0, -0.7])
    times = np.array([0.0, 2.0])
    A_exact, w_exact = rigid_body_motion(INERTIA, np.eye(3), spin, lambda _: np.zeros(3), times)
    for scheme, order in (("energy_momentum", 2), ("bdf2", 2), ("generalized_alpha", 2), ("backward_euler", 1)):
        errors = []
        for h in (0.008, 0.004):
            model, part = free_part(spin=spin)
            sim = wf.Simulation(model, dt=h, integrator=scheme, **TIGHT)
            sim.step(round(2.0 / h))
            errors.append(np.abs(rotation(sim, part) - A_exact[-1]).max())
            assert np.abs(rotation(sim, part).T @ rotation(sim, part) - np.eye(3)).max() < 1e-11
        assert np.log2(errors[0] / errors[1]) > order - 0.25, scheme
        assert errors[1] < (1e-4 if order == 2 else 2e-2), scheme


@pytest.mark.parametrize("steps", [200, pytest.param(10_000, marks=pytest.mark.slow)])
def test_thin_disc_has_a_singular_mass_and_moves_as_eulers_equations_say(steps: int) -> None:
    inertia, spin = np.array([1.0, 1.0, 2.0]), np.array([0.3, 0.0, 2.0])
    A_exact, _ = rigid_body_motion(inertia, np.eye(3), spin, lambda _: np.zeros(3), np.array([0.0, 1.0]))
    model, part = free_part(inertia, spin)
    assert np.linalg.matrix_rank(model.masses.world_matrix(0).toarray(), tol=1e-10) == 3
    sim = wf.Simulation(model, dt=5e-3, integrator="energy_momentum", **TIGHT)
    L0, E0 = momenta(model, sim)
    sim.step(200)
    assert np.abs(rotation(sim, part) - A_exact[-1]).max() < 1e-4
    if steps > 200:
        sim.step(steps - 200)
    L, E = momenta(model, sim)
    bound = 1e-11 if steps == 200 else 1e-10
    assert np.linalg.norm(L - L0) < bound * np.linalg.norm(L0)
    assert abs(E - E0) < bound * E0


def test_rod_without_a_third_inertia() -> None:
    """It turns about an axis across at a constant rate, and hangs from a point as a pendulum of the period
    2 pi sqrt(J / (m g l))."""
    model, part = free_part((1.0, 1.0, 0.0), (0.6, 0.8, 0.0))
    sim = wf.Simulation(model, dt=5e-3, integrator="energy_momentum", **TIGHT)
    L0, E0 = momenta(model, sim)
    sim.step(200)
    L, E = momenta(model, sim)
    assert np.linalg.norm(L - L0) < 1e-11 * np.linalg.norm(L0)
    assert abs(E - E0) < 1e-11 * E0
    exact = Rotation.from_rotvec([0.6, 0.8, 0.0]).as_matrix()
    assert np.abs(rotation(sim, part) - exact).max() < 1e-5
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    rod = b.add_rigid(wf.Box((0, 0, -0.5), (0.01, 0.01, 1.0)), mass=1.0, inertia=(1 / 12, 1 / 12, 0.0), name="rod")
    b.add_joint("spherical", parent=wf.GROUND, child=rod.at((0, 0, 0)))
    b.set_initial(rod, velocity=(0.005, 0, 0), angular_velocity=(0, -0.01, 0))
    w = np.sqrt(9.81 * 0.5 * 3.0)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=2e-3, integrator="energy_momentum", **TIGHT)
    sim.run(1.0)
    assert sim.pose(rod)[0][0, 0] == pytest.approx(0.005 / w * np.sin(w), abs=1e-4 * 0.005 / w)


def test_heavy_top() -> None:
    arm, mass, inertia, spin = 0.2, 2.0, np.array([0.03, 0.03, 0.01]), np.array([0.0, 2.0, 60.0])
    tilt = 0.4
    A0 = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
    about_tip = inertia + mass * arm**2 * np.array([1.0, 1.0, 0.0])
    g = np.array([0, 0, -9.81])
    weight = lambda A: np.cross([0, 0, arm], mass * A.T @ g)  # noqa: E731
    times = np.array([0.0, 0.2])
    A_exact, _ = rigid_body_motion(about_tip, A0, spin, weight, times)
    errors = []
    for h in (2e-4, 1e-4):
        b = wf.ModelBuilder()
        part = b.add_rigid(
            wf.Cylinder((0, 0, 0), (0, 0, 2 * arm), 0.1), mass=mass, inertia=inertia, com=(0, 0, arm), name="top"
        )
        b.add_joint("spherical", parent=wf.GROUND, child=part.at((0, 0, 0)))
        b.set_initial(part, displacement=lambda X: X @ A0.T - X, velocity=lambda X: np.cross(A0 @ spin, X @ A0.T))
        sim = wf.Simulation(b.finalize(device="cpu"), dt=h, integrator="energy_momentum", **TIGHT)
        sim.step(round(times[-1] / h))
        errors.append(np.abs(rotation(sim, part) - A_exact[-1]).max())
    assert errors[1] < 1e-4
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.05)


def test_rigid_pendulum_swings_as_elliptic_functions() -> None:
    length, mass = 1.0, 3.0
    errors = []
    for h in (2e-3, 1e-3):
        b = wf.ModelBuilder()
        part = b.add_rigid(wf.Box((0.5, 0, 0), (1.0, 0.1, 0.1)), mass=mass, name="bar")
        about_hinge = part.inertia[1, 1] + mass * 0.25
        hinge = b.add_joint("revolute", parent=wf.GROUND, child=part.at((0, 0, 0)), axis=(0, 1, 0))
        sim = wf.Simulation(b.finalize(device="cpu"), dt=h, integrator="energy_momentum", **TIGHT)
        sim.step(round(1.2 / h))
        omega = np.sqrt(mass * 9.81 * 0.5 * length / about_hinge)
        k2 = 0.5  # sin^2 of half the largest angle from the vertical, 90 degrees
        sn = ellipj(ellipk(k2) - omega * 1.2, k2)[0]
        below = 2.0 * np.arcsin(np.sqrt(k2) * sn)  # angle from the vertical
        errors.append(abs(float(sim.joint_value(hinge)[0]) - (0.5 * np.pi - below)))
    assert errors[1] < 1e-5
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.05)


@pytest.mark.parametrize("shape", ["box", "sphere", "cylinder", "capsule"])
def test_moments_of_shapes_are_those_of_fine_meshes(shape: str) -> None:
    given = {
        "box": wf.Box((1, 2, 3), (0.1, 0.2, 0.4)),
        "sphere": wf.Sphere((1, 2, 3), 0.3),
        "cylinder": wf.Cylinder((1, 2, 3), (1.2, 2.5, 3.1), 0.2),
        "capsule": wf.Capsule((1, 2, 3), (1.2, 2.5, 3.1), 0.2),
    }[shape]
    b = wf.ModelBuilder()
    exact = b.add_rigid(given, density=700.0)
    errors = []
    for n in (64, 128):
        meshed = b.add_rigid(wf.TriMesh(*given.mesh(n)), density=700.0)
        np.testing.assert_allclose(meshed.com, exact.com, atol=1e-12)
        errors.append(np.abs(meshed.inertia - exact.inertia).max() / np.abs(exact.inertia).max())
    assert errors[1] < 2e-3
    assert shape == "box" or errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)


def test_moments_of_a_concave_surface_and_of_volume_meshes() -> None:
    """An L-shaped block, whose centre of mass lies off some of its faces' inner sides, against its two boxes."""
    size, mesh = (1.0, 1.0, 0.3), wf.mesh.box((1.0, 1.0, 0.3), cells=(2, 2, 1), element="T4")
    keep = ~((mesh.centroids()[:, 0] > 0.5) & (mesh.centroids()[:, 1] > 0.5))
    block = wf.mesh.Mesh(mesh.points, mesh.cells[keep], "tetra")
    part = wf.ModelBuilder().add_rigid(block, density=2.0)
    solid = wf.ModelBuilder().add_solid(block, material=wf.SVK(E=1e6, nu=0.3, density=2.0))
    from warpfea.model.masses import body_mass

    M = body_mass(solid)
    X = np.column_stack([np.ones(len(block.points)), block.points - part.com])
    used = solid.node_slot >= 0
    rows = np.empty((solid.slot_count, 4))
    rows[solid.node_slot[used]] = X[used]
    moments = rows.T @ M @ rows
    np.testing.assert_allclose(part.moments * 2.0, moments, atol=1e-14)
    assert part.mass == pytest.approx(2.0 * 0.75 * np.prod(size))
    for element in ("T10", "H3843"):
        box = wf.ModelBuilder().add_rigid(wf.mesh.box(size, cells=(2, 1, 1), element=element), density=2.0)
        np.testing.assert_allclose(
            box.inertia, wf.ModelBuilder().add_rigid(wf.Box((0.5, 0.5, 0.15), size), density=2.0).inertia, atol=1e-14
        )
        assert len(box.surface("x+")) > 0


def test_soft_bar_between_rigid_plates_has_uniform_stress() -> None:
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    bar = b.add_solid(
        wf.mesh.box((1, 0.1, 0.1), cells=(4, 1, 1)), material=wf.SVK(E=1e7, nu=0.0, density=1000.0), name="bar"
    )
    held, pulled = (b.add_rigid(wf.Box((x, 0.05, 0.05), (0.1, 0.1, 0.1)), mass=1.0) for x in (-0.05, 1.05))
    b.weld(bar.surface("x-"), held)
    b.weld(bar.surface("x+"), pulled)
    b.clamp(held.nodes(held.surface_nodes))
    b.add_point_load(pulled.at((1.05, 0.05, 0.05)), (1000.0, 0, 0))
    found = wf.solve_static(b.finalize(device="cpu"), tol=1e-12, constraint_tol=1e-12)
    stretch = 1.0 + float(found.state.displacement.numpy()[0, pulled.slots, 0].mean())
    assert 0.01 * 1e7 * 0.5 * (stretch**2 - 1.0) * stretch == pytest.approx(1000.0, rel=1e-8)
    F = np.array([stretch, 1.0, 1.0])
    stress = found.field("von_mises", bar)[0]
    np.testing.assert_allclose(stress, 1e7 * 0.5 * (F[0] ** 2 - 1.0) * F[0], rtol=1e-8)


def double_pendulum(mass: float, tip_mass: float) -> tuple[Any, np.ndarray]:
    """Two rods, l = 1 m, hinged at their ends, from horizontal; tip after 0.5 s by the equations in the two angles."""

    def rate(_: float, y: np.ndarray) -> np.ndarray:
        a, b, da, db = y  # angles below the horizontal, rods with the moments of their box
        c, s = np.cos(a - b), np.sin(a - b)
        M = np.array([[(J + 0.25) * mass + m, 0.5 * m * c], [0.5 * m * c, (J + 0.25) * m]])
        f = np.array([(0.5 * mass + m) * g * np.cos(a) - 0.5 * m * s * db**2,
                      0.5 * m * g * np.cos(b) + 0.5 * m * s * da**2])  # fmt: skip
        return np.concatenate([[da, db], np.linalg.solve(M, f)])

    m, g, J = tip_mass, 9.81, (1.0 + 0.01) / 12.0
    y = solve_ivp(rate, (0, 0.5), np.zeros(4), "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    b = wf.ModelBuilder()
    p, q = (b.add_rigid(wf.Box((x, 0, 0), (1.0, 0.1, 0.1)), mass=m) for x, m in ((0.5, mass), (1.5, tip_mass)))
    b.add_joint("revolute", parent=wf.GROUND, child=p.at((0, 0, 0)), axis=(0, 1, 0))
    b.add_joint("revolute", parent=p.at((1, 0, 0)), child=q.at((1, 0, 0)), axis=(0, 1, 0))
    b.add_probe("tip", q.at((2, 0, 0)))
    return b, np.array([np.cos(y[0]) + np.cos(y[1]), 0.0, -np.sin(y[0]) - np.sin(y[1])])


@pytest.mark.parametrize("scheme", ["backward_euler", "bdf2", "energy_momentum", "generalized_alpha"])
def test_rigid_double_pendulum_follows_lagranges_equations(scheme: str) -> None:
    errors = []
    for h in (1e-3, 5e-4):
        b, tip = double_pendulum(10.0, 10.0)
        sim = wf.Simulation(b.finalize(device="cpu"), dt=h, integrator=scheme, **TIGHT)
        sim.step(round(0.5 / h))
        errors.append(np.abs(sim.probe("tip").position.reshape(-1, 3)[-1] - tip).max())
    first_order = scheme == "backward_euler"
    assert errors[1] < (2e-3 if first_order else 1e-5)
    assert errors[0] / errors[1] == pytest.approx(2.0 if first_order else 4.0, rel=0.1)


def test_a_light_rod_carries_a_heavy_one() -> None:
    """1e-6 kg carry 0.01 to 1000 kg; errors are those of equal masses."""
    for scheme, ratio in (("bdf2", 1e4), ("energy_momentum", 1e9), ("generalized_alpha", 1e6), ("backward_euler", 1e6)):
        b, tip = double_pendulum(1e-6, 1e-6 * ratio)
        sim = wf.Simulation(b.finalize(device="cpu"), dt=5e-3, integrator=scheme)
        sim.step(100)
        error = np.abs(sim.probe("tip").position.reshape(-1, 3)[-1] - tip).max()
        assert error < (1e-2 if scheme == "backward_euler" else 1e-3), (scheme, ratio, error)


def test_all_rigid_slider_crank_moves_as_its_geometry_says() -> None:
    r, rod_length = 0.1, 0.3
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    crank = b.add_rigid(wf.Box((r / 2, 0, 0), (r, 0.02, 0.02)), density=1000.0)
    rod = b.add_rigid(wf.Box((r + rod_length / 2, 0, 0), (rod_length, 0.02, 0.02)), density=1000.0)
    slider = b.add_rigid(wf.Box((r + rod_length, 0, 0), (0.04, 0.04, 0.04)), density=1000.0)
    b.add_joint("revolute", parent=wf.GROUND, child=crank.at((0, 0, 0)), axis=(0, 1, 0), drive=([0, 1], [0, 5]))
    b.add_joint("revolute", parent=crank.at((r, 0, 0)), child=rod.at((r, 0, 0)), axis=(0, 1, 0))
    b.add_joint(
        "revolute", parent=rod.at((r + rod_length, 0, 0)), child=slider.at((r + rod_length, 0, 0)), axis=(0, 1, 0)
    )
    b.add_joint("translational", parent=wf.GROUND, child=slider.at((r + rod_length, 0, 0)), axis=(1, 0, 0))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=5e-3, constraint_tol=1e-10)
    for _ in range(60):
        sim.step()
        angle = -5.0 * float(sim.time[0])
        exact = r * np.cos(angle) + np.sqrt(rod_length**2 - (r * np.sin(angle)) ** 2)
        assert float(sim.pose(slider)[0][0, 0]) == pytest.approx(exact, abs=1e-8)


def test_masses_that_differ_a_billion_times() -> None:
    """A speck of 1e-6 kg hung on a block of 1e3 kg: the force of their joint is its weight."""
    b = wf.ModelBuilder()
    block = b.add_rigid(wf.Box((0, 0, 0), (1, 1, 1)), mass=1e3)
    speck = b.add_rigid(wf.Box((0, 0, -0.501), (0.002, 0.002, 0.002)), mass=1e-6)
    hinge = b.add_joint("spherical", parent=block.at((0, 0, -0.5)), child=speck.at((0, 0, -0.5)))
    b.add_joint("spherical", parent=wf.GROUND, child=block.at((0, 0, 0)))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3, **TIGHT)
    sim.step(50)
    np.testing.assert_allclose(sim.joint_force(hinge)[0, :3], [0, 0, 9.81e-6], atol=1e-10)


def test_flexible_bars_tend_to_the_rigid_one_as_they_stiffen() -> None:
    """Sag of the tip of a hinged falling bar after 0.1 s beside the rigid bar: as 1/E."""

    def tip(E: float | None) -> np.ndarray:
        b = wf.ModelBuilder()
        if E is None:
            bar = b.add_rigid(wf.Box((0.5, 0, 0), (1.0, 0.1, 0.1)), density=1000.0)
        else:
            bar = b.add_beam(
                [(0, 0, 0), (1, 0, 0)], elements=4, section=wf.Rectangle(0.1, 0.1), normal=(0, 0, 1),
                material=wf.SVK(E=E, nu=0.0, density=1000.0),
            )  # fmt: skip
        b.add_joint("revolute", parent=wf.GROUND, child=bar.at((0, 0, 0)), axis=(0, 1, 0))
        b.add_probe("tip", bar.at((1, 0, 0)))
        sim = wf.Simulation(b.finalize(device="cpu"), dt=2e-3, **TIGHT)
        sim.step(50)
        return np.asarray(sim.probe("tip").position.reshape(-1, 3)[-1])

    rigid = tip(None)
    errors = [np.abs(tip(E) - rigid).max() for E in (1e8, 1e9, 1e10)]
    assert errors[2] < 1e-5
    assert errors[0] / errors[1] == pytest.approx(10.0, rel=0.2)
    assert errors[1] / errors[2] == pytest.approx(10.0, rel=0.2)


def test_block_slides_up_a_slope_and_stops_where_coulomb_says() -> None:
    """Rigid on an obstacle: v^2/2g(sin a + mu cos a) along the slope, then it rests as tan a < mu."""
    slope, mu, v0 = 0.3, 0.5, 2.0
    n = np.array([-np.sin(slope), 0, np.cos(slope)])
    t = np.array([np.cos(slope), 0, np.sin(slope)])
    b = wf.ModelBuilder()
    axes = np.array([t, [0, 1, 0], n])
    block = b.add_rigid(wf.Box(0.05 * n, (0.1, 0.1, 0.1), axes=axes), density=1000.0)
    floor = b.add_collider(wf.HalfSpace(normal=n, offset=0.0))
    b.add_contact(block, floor, mu=mu)
    b.set_initial(block, velocity=v0 * t)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=2.5e-4)
    sim.step(1500)
    travel = float((sim.pose(block)[0][0] - 0.05 * n) @ t)
    assert travel == pytest.approx(v0**2 / (2 * 9.81 * (np.sin(slope) + mu * np.cos(slope))), rel=1.5e-3)
    assert np.abs(sim.velocities(block)).max() < 1e-6


def test_stack_of_rigid_blocks_on_a_soft_one() -> None:
    """Weights of three blocks on a soft bed: contact forces 3, 2 and 1 times one weight."""
    b = wf.ModelBuilder()
    bed = b.add_solid(
        wf.mesh.box((0.2, 0.2, 0.1), cells=(4, 4, 2), origin=(-0.1, -0.1, -0.1), element="T4"),
        material=wf.SVK(E=1e6, nu=0.3, density=1000.0, damping=wf.KelvinVoigt(eta=300.0)), name="bed",
    )  # fmt: skip
    b.clamp(bed.nodes("z-"))
    blocks = [b.add_rigid(wf.Box((0, 0, 0.05 + 0.1 * k), (0.1, 0.1, 0.1)), mass=1.0) for k in range(3)]
    sides = [bed, *blocks]
    contacts = [b.add_contact(upper, lower, mu=0.5) for lower, upper in itertools.pairwise(sides)]
    sim = wf.Simulation(b.finalize(device="cpu"), dt=5e-3)
    sim.step(100)
    for k, contact in enumerate(contacts):
        assert sim.contact_force(contact)[0, 2] == pytest.approx((3 - k) * 9.81, rel=1e-8)
    assert max(float(np.abs(sim.velocities(block)).max()) for block in blocks) < 1e-6


def swing(worlds: int = 1, dtype: str = "float64", device: str = "cpu") -> tuple[wf.Model, Any, Any]:
    b = wf.ModelBuilder()
    part = b.add_rigid(wf.Box((0.5, 0, 0), (1.0, 0.1, 0.1)), density=1000.0, name="part")
    b.add_joint("revolute", parent=wf.GROUND, child=part.at((0, 0, 0)), axis=(0, 1, 0), name="hinge")
    beam = b.add_beam(
        [(1, 0, 0), (1.5, 0, 0)], elements=2, section=wf.Rectangle(0.05, 0.05), normal=(0, 0, 1),
        material=wf.SVK(E=1e8, nu=0.3, density=1000.0), name="beam",
    )  # fmt: skip
    b.weld(beam.start, part)
    return b.finalize(device=device, worlds=worlds, dtype=dtype), part, beam


def test_worlds_are_equal_to_lone_runs_and_checkpoints_go_on(tmp_path: Any) -> None:
    model, part, beam = swing(3)
    density = np.array([500.0, 1000.0, 1500.0])
    model.set_parameter("part.density", density)
    sim = wf.Simulation(model, dt=2e-3)
    sim.run(t_end=0.04, outputs=[wf.Checkpoint(tmp_path / "c.npz", every=10)])
    sim.step(10)
    for k in range(3):
        alone, own, rod = swing()
        alone.set_parameter("part.density", density[k : k + 1])
        one = wf.Simulation(alone, dt=2e-3)
        one.step(30)
        np.testing.assert_array_equal(one.positions(rod)[0], sim.positions(beam)[k])
        np.testing.assert_array_equal(one.pose(own)[1][0], sim.pose(part)[1][k])
    again = wf.Simulation(model, dt=2e-3)
    again.resume(tmp_path / "c.npz")
    again.step(10)
    np.testing.assert_array_equal(again.positions(part), sim.positions(part))


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_devices_and_precisions_agree(device: Any, dtype: str) -> None:
    ends = []
    for where, precision in (("cpu", "float64"), (device, dtype)):
        model, _, beam = swing(dtype=precision, device=where)
        sim = wf.Simulation(model, dt=2e-3)
        sim.step(50)
        ends.append(sim.positions(beam)[0, -1])
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-9 if dtype == "float64" else 2e-6)


def test_observed_axes_and_centre_are_those_of_the_pose() -> None:
    model, part, _ = swing()
    sim = wf.Simulation(model, dt=2e-3)
    observed = sim.observe("part.part.position", "part.part.axes", "part.part.axes_rate", "body.part.velocity")
    sim.step(20)
    observed.update()
    row = observed.array.numpy()[0]
    np.testing.assert_allclose(row[:3], sim.pose(part)[0][0], atol=1e-14)
    A, rate = (row[k : k + 9].reshape(3, 3).T for k in (3, 12))
    np.testing.assert_allclose(A, rotation(sim, part), atol=1e-12)
    spin = rate @ A.T
    np.testing.assert_allclose([spin[2, 1], spin[0, 2], spin[1, 0]], sim.angular_velocity(part)[0], atol=1e-12)
    np.testing.assert_allclose(row[21:].reshape(-1, 3), sim.velocities(part)[0], atol=1e-13)


def test_sides_have_names() -> None:
    """Those of a box and a cylinder along their own axes; loads on them are those of the true faces."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    turn = Rotation.from_rotvec([0.3, -0.5, 1.1]).as_matrix()
    box = b.add_rigid(wf.Box((1, 2, 3), (0.2, 0.3, 0.5), axes=turn.T), mass=1.0)
    rod = b.add_rigid(wf.Cylinder((0, 0, 0), (0, 2, 0), 0.1), mass=1.0)
    sides = {"x-": -turn[:, 0], "x+": turn[:, 0], "y-": -turn[:, 1], "y+": turn[:, 1], "z-": -turn[:, 2]}
    for name, normal in sides.items():
        x = facet_positions(box, facet_tables(box.surface(name)))
        assert (x - (1, 2, 3)) @ normal == pytest.approx(0.5 * (0.2, 0.3, 0.5)["xyz".index(name[0])])
    for name, area in (("bottom", np.pi * 0.01), ("top", np.pi * 0.01), ("side", 0.4 * np.pi)):
        surface = rod.surface(name)
        assert facet_areas(rod, facet_tables(surface)).sum() == pytest.approx(area, rel=5e-3)
    assert facet_positions(rod, facet_tables(rod.surface("top")))[..., 1] == pytest.approx(2.0)
    b.add_traction(box.surface("z+"), (0.0, 0.0, 100.0))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    sim.step()
    assert sim.velocities(box)[0].mean(axis=0)[2] == pytest.approx(100.0 * 0.06 * 1e-3)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda b: b.add_rigid(wf.TriMesh(np.eye(3), [(0, 1, 2)]), density=1.0), "the mesh is open"),
        (lambda b: b.add_rigid(wf.Box((0, 0, 0), (1, 1, 1))), "give either density="),
        (lambda b: b.add_rigid(wf.Box((0, 0, 0), (1, 1, 1)), density=1.0, mass=1.0), "give either density="),
        (lambda b: b.add_rigid(wf.Box((0, 0, 0), (1, 1, 1)), mass=-1.0), "mass = -1.0 must be a positive"),
        (lambda b: b.add_rigid(wf.Box((0, 0, 0), (1, 1, 1)), mass=1.0, inertia=(1, 1, 3)), "none larger than the sum"),
        (lambda b: b.add_rigid(wf.Box((0, 0, 0), (1, 1, 1)), mass=1.0, inertia=(0, 0, 0)), "must be positive"),
        (lambda b: b.add_rigid(wf.Box((0, 0, 0), (1, 1, 1)), mass=1.0, inertia=1.0), "must be a symmetric"),
        (lambda b: b.add_rigid(wf.Box((0, 0, 0), (1, 1, 1)), mass=1.0, com=(0, 0, 0.1)), "give inertia= about it"),
        (lambda b: b.add_rigid("part.stl", mass=1.0), "expected a wf.Box"),
        (lambda b: b.add_rigid(wf.mesh.grid((1, 1), cells=(1, 1)), mass=1.0), "expected a volume"),
        (lambda b: b.clamp(b.add_rigid(wf.Box((0, 0, 0), (1, 1, 1)), density=1.0).nodes(lambda X: X[:, :2].max(1) < 0)),
         "on one line do not hold it"),
    ],
)  # fmt: skip
def test_bad_parts_are_named(make: Any, text: str) -> None:
    with pytest.raises(wf.ModelError, match=text):
        make(wf.ModelBuilder())


@pytest.mark.filterwarnings("error")
def test_small_part_of_steel_is_no_reason_to_warn() -> None:
    b = wf.ModelBuilder()
    part = b.add_rigid(wf.Box((0, 0, 0), (1e-2, 1e-3, 1e-3)), density=7850.0)
    assert b.finalize(device="cpu").mass == pytest.approx(7850.0 * 1e-8)
    assert part.mass == pytest.approx(7850.0 * 1e-8)


def test_chain_of_twenty_parts_with_a_heavy_end_keeps_its_energy() -> None:
    b = wf.ModelBuilder()
    held: Any = wf.GROUND
    for k in range(20):
        link = b.add_rigid(wf.Box((0.1 * k + 0.05, 0, 0), (0.1, 0.02, 0.02)), mass=100.0 if k == 19 else 1.0)
        b.add_joint("spherical", parent=held, child=link.at((0.1 * k, 0, 0)), anchor=(0.1 * k, 0, 0))
        held = link.at((0.1 * k + 0.1, 0, 0))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=2e-3, integrator="energy_momentum")
    sim.step(100)
    energy = sim.energies()
    assert float(energy["kinetic"][0]) > 100.0
    assert abs(float(energy["kinetic"][0] + energy["potential"][0])) < 1e-6 * float(energy["kinetic"][0])
    assert int(sim.totals["newton"][0]) <= 300
