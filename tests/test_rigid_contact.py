"""Rigid parts at work: stiff ones at rest, a wedge, a gyroscope on a flexible shaft."""

import numpy as np
import pytest
import scipy.linalg

import warpfea as wf

GRAVITY = 9.81


@pytest.mark.parametrize("height", [0.2, 2.0])
def test_a_stiff_part_comes_to_rest(height):
    """A block of 2e11 Pa falls: its weight indents the contact by less than what its position resolves the force to."""
    b = wf.ModelBuilder()
    steel = wf.SVK(E=2e11, nu=0.3, density=7850.0)
    block = b.add_rigid(wf.Box((0, 0, 0), (0.1, 0.1, 0.1)), density=7850.0, material=steel)
    contact = b.add_contact(block, b.add_collider(wf.HalfSpace((0, 0, 1), -height - 0.05)), mu=0.3)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3, integrator="bdf2")
    sim.run(np.sqrt(2 * height / GRAVITY) + 0.1)
    assert sim.pose(block)[0][0] == pytest.approx([0, 0, -height], abs=1e-8)
    force = sim.contact_record(contact).force[0, -20:, 2]
    assert force.mean() == pytest.approx(block.mass * GRAVITY, rel=1e-3)


@pytest.mark.parametrize("scheme", ["backward_euler", "bdf2", "generalized_alpha", "energy_momentum"])
def test_restitution_0_returns_nothing(scheme):
    """Rigid parts stop, at steps of half and twice the time of the wave through them; no step is
    refused for energy that an integrator adds."""
    shapes = {"ball": wf.Sphere((0, 0, 0.06), 0.05), "box": wf.Box((0, 0, 0.06), (0.1, 0.1, 0.1))}
    for shape, h, speed in (("ball", 5e-4, 10.0), ("box", 5e-4, 1.0), ("ball", 2e-3, 10.0)):
        b = wf.ModelBuilder()
        part = b.add_rigid(shapes[shape], mass=1.0)
        b.add_contact(part, b.add_collider(wf.HalfSpace(normal=(0, 0, 1))))
        b.set_initial(part, velocity=(0, 0, -speed))
        sim = wf.Simulation(b.finalize(device="cpu"), dt=h, integrator=scheme)
        returned = []
        for _ in range(round(0.01 / speed / h) + 30):
            sim.step()
            returned.append(float(sim.velocities(part)[0, :, 2].max()))
        assert max(returned) < 0.025 * speed, (shape, h, speed, max(returned))


def test_a_speck_far_from_its_place_is_refused_for_round_off():
    """1e-9 m long, after a fall of 3 m its positions are known to a millionth of that; parts answer to their names."""
    b = wf.ModelBuilder()
    b.set_initial(b.add_rigid(wf.Box((0, 0, 0), (1e-9, 1e-9, 1e-9)), density=1e3, name="speck"),
                  angular_velocity=(0, 0, 1))  # fmt: skip
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-2, integrator="energy_momentum")
    np.testing.assert_allclose(sim.angular_velocity("speck"), [[0, 0, 1]])
    with pytest.raises(wf.ConstraintError, match=r"round-off of positions .* m from the reference is larger"):
        sim.run(2.0)
    assert sim.pose("speck")[0][0, 2] < -1.0
    b = wf.ModelBuilder()  # a point of 30 um that is drawn as a box of 1 m
    part = b.add_rigid(wf.Box((0, 0, 0), (1, 1, 1)), mass=1.0, inertia=(1e-9, 1e-9, 1e-9))
    b.set_initial(part, angular_velocity=(1.0, 0.1, 0.2))
    with pytest.raises(wf.ConvergenceError, match="inertias beside mass times size"):
        wf.Simulation(b.finalize(device="cpu"), dt=1e-2, integrator="energy_momentum").run(0.3)


def test_violations_at_the_round_off_of_positions_in_float32():
    """A part of 0.1 m that turns and flies: after 60 m its points are known to four times the tolerance; the
    violation is told, and refused beyond 2e-3 of its size."""
    for speed in (1e2, 1e4):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        part = b.add_rigid(wf.Box((0, 0, 0), (0.1, 0.1, 0.1)), mass=1.0, name="part")
        b.set_initial(part, velocity=(speed, 0, 0), angular_velocity=(1, 2, 3))
        sim = wf.Simulation(b.finalize(device="cpu", dtype="float32"), dt=1e-2, integrator="bdf2")
        if speed > 1e3:
            with pytest.raises(wf.ConvergenceError, match="float32 round-off"):
                sim.run(2.0)
            continue
        violation, newton = np.array([(r.violation[0], r.newton[0]) for r in (sim.step() for _ in range(60))]).T
        assert 1e-6 * sim.model.size < violation.max() < 2e-3 * sim.model.size
        assert newton.mean() < 4
        np.testing.assert_allclose(sim.angular_velocity(part)[0], [1, 2, 3], rtol=5e-3)
        np.testing.assert_allclose(sim.pose(part)[0][0], [60, 0, 0], atol=5e-4)


def test_a_wedge_under_a_block():
    """Without friction: the wedge's acceleration m g tan(a)/(M + m tan(a)^2) under a block that is guided upright."""
    slope = 0.4
    b = wf.ModelBuilder(gravity=(0, 0, -GRAVITY))
    top, x, z = np.tan(slope), np.cos(slope), np.sin(slope)
    y = np.repeat([-0.3, 0.3], 3)
    points = np.column_stack([np.tile([0.0, 1.0, 0.0], 2), y, np.tile([0.0, 0.0, top], 2)])
    triangles = [(0, 1, 2), (3, 5, 4), (0, 3, 4), (0, 4, 1), (1, 4, 5), (1, 5, 2), (2, 5, 3), (2, 3, 0)]
    wedge = b.add_rigid(wf.TriMesh(points, triangles), mass=3.0, inertia=(1, 1, 1), com=(0.3, 0, 0.1), name="wedge")
    axes = np.array([(x, 0, -z), (0, 1, 0), (z, 0, x)])
    middle = np.array([0.5, 0.0, 0.5 * top]) + 0.05 * axes[2]
    block = b.add_rigid(wf.Box(middle, (0.2, 0.2, 0.1), axes=axes), mass=2.0, inertia=(0.01, 0.01, 0.01), name="block",
                        com=middle)  # fmt: skip
    b.add_joint("translational", parent=wf.GROUND, child=block.at(middle), axis=(0, 0, 1))
    b.add_contact(wedge, b.add_collider(wf.HalfSpace((0, 0, 1))))
    pair = b.add_contact(block, wedge)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=2e-3, integrator="bdf2")
    speeds = []
    for _ in range(2):  # past the landing
        sim.step(30)
        speeds.append(wedge.affine[0] @ sim.state.velocity.numpy()[0, wedge.slots, 0])
    exact = 2.0 * GRAVITY * top / (3.0 + 2.0 * top**2)
    assert speeds[0] - speeds[1] == pytest.approx(exact * 0.06, rel=1e-6)
    assert sim.contact_record(pair).force[0, -30:, 0].mean() == pytest.approx(3.0 * exact, rel=1e-6)


@pytest.mark.slow
def test_critical_speed_of_a_gyroscope_on_a_flexible_shaft():
    """At the critical speed a forward whirl has the speed of the spin: det(K - w^2 diag(m, I_d - I_p)) = 0 of an
    overhung disc, which tilts; without its gyroscopic moment that speed is 7 % lower."""
    L, r, E = 0.5, 0.01, 2e11
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    shaft = b.add_beam([(0, 0, 0), (L, 0, 0)], elements=3, section=wf.Circle(r), normal=(0, 0, 1),
                       material=wf.SVK(E=E, nu=0.3, density=1.0))  # fmt: skip
    b.clamp(shaft.start, slots="position+section")
    disc = b.add_rigid(wf.Cylinder((L - 0.01, 0, 0), (L + 0.01, 0, 0), 0.15), density=3000.0, name="disc")
    b.add_joint("revolute", parent=shaft.end, child=disc.at((L, 0, 0)), axis=(1, 0, 0))
    K = E * np.pi * r**4 / 4 / L**3 * np.array([(12, -6 * L), (-6 * L, 4 * L**2)])
    polar, across = disc.inertia[0, 0], disc.inertia[1, 1]
    speeds = scipy.linalg.eigvals(K, np.diag([disc.mass, across - polar])).real
    critical = np.sqrt(speeds[speeds > 0.0].min())
    plain = np.sqrt(scipy.linalg.eigvalsh(K, np.diag([disc.mass, across])).min())
    assert critical > 1.05 * plain
    b.set_initial(disc, angular_velocity=(critical, 0, 0))
    pulse = ([0.0, 0.005, 0.01], [(0, 0, 0), (0, 50.0, 0), (0, 0, 0)])
    b.add_point_load(disc.at((L, 0, 0)), force=pulse)
    b.add_probe("p", disc.at((L, 0, 0)))
    h, turns = 2.5e-3, 8
    sim = wf.Simulation(b.finalize(device="cpu"), dt=h, integrator="energy_momentum")
    sim.run(0.01 + turns * 2 * np.pi / critical)
    p = sim.probe("p")
    late = p.time > 0.01
    signal, t = p.displacement[0, late, 1] + 1j * p.displacement[0, late, 2], p.time[late]
    trial = critical * np.linspace(0.8, 1.2, 801)
    power = np.abs(np.exp(-1j * np.outer(trial, t)) @ (signal * np.hanning(len(t))))
    assert trial[np.argmax(power)] == pytest.approx(critical, rel=1e-2)


def test_dampers_in_steps_that_impacts_set_to_backward_euler():
    """While boxes fall again and again: a damped slide has v exp(-c t/m), and a damped cube swings as beside none."""
    swings = []
    for count in (0, 2):
        b = wf.ModelBuilder()
        for k in range(count):
            box = b.add_rigid(wf.Box((0.3 * k, 0, 0.0505 + 0.02 * k), (0.1, 0.1, 0.1)), mass=1.0)
            b.add_contact(box, b.add_collider(wf.HalfSpace((0, 0, 1))), mu=0.3)
            b.set_initial(box, velocity=(0, 0, -1), angular_velocity=(5 * k, 3, 0))
        part = b.add_rigid(wf.Box((0, 3, 1), (0.1, 0.1, 0.1)), mass=1.0)
        slide = b.add_joint("translational", parent=wf.GROUND, child=part.at((0, 3, 1)), axis=(1, 0, 0), damping=1.0)
        b.set_initial(part, velocity=(2, 0, 0))
        cube = b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1), origin=(0, 5, 1)), material=wf.SVK(
            E=1e5, nu=0.0, density=1000.0, damping=wf.KelvinVoigt(eta=1e4, lambda_v=0.0)))  # fmt: skip
        b.clamp(cube.nodes("z-"))
        b.set_initial(cube, velocity=lambda X: 5.0 * (X[:, 2:] - 1.0) * (1.0, 0.0, 0.0))
        sim = wf.Simulation(b.finalize(device="cpu"), dt=5e-3, integrator="energy_momentum")
        sim.run(0.2)
        assert sim.joint_rate(slide)[0] == pytest.approx(2 * np.exp(-0.2), rel=1e-3)
        assert sim.joint_value(slide)[0] == pytest.approx(2 - 2 * np.exp(-0.2), rel=1e-3)
        swings.append(sim.displacements(cube)[0])
    assert np.abs(swings[1] - swings[0]).max() < 0.01 * np.abs(swings[0]).max()


def test_a_drive_in_steps_that_impacts_set_to_backward_euler():
    """A wheel has the speed of its drive while a ball stops on the floor."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    ball = b.add_rigid(wf.Sphere((0, 0, 0.0613), 0.05), mass=1.0)
    b.add_contact(ball, b.add_collider(wf.HalfSpace(normal=(0, 0, 1))))
    b.set_initial(ball, velocity=(0, 0, -10.0))
    wheel = b.add_rigid(wf.Cylinder((5, 0, 1), (5, 0.1, 1), 0.2), mass=1.0)
    hinge = b.add_joint("revolute", parent=wf.GROUND, child=wheel.at((5, 0, 1)), axis=(0, 1, 0))
    b.add_velocity_constraint("speed", hinge, value=3.0)
    b.set_initial(wheel, angular_velocity=(0, 3.0, 0))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3, integrator="energy_momentum", constraint_tol=1e-12)
    sim.step(6)
    assert sim.joint_value(hinge)[0] == pytest.approx(0.018, rel=1e-5)
    assert sim.energies()["integrator"][0] > 10.0


def test_impacts_that_backward_euler_does_not_solve_stay_those_of_the_scheme():
    """Boxes that tumble onto the floor with friction: their steps were refused at once."""
    b = wf.ModelBuilder()
    for k in range(2):
        box = b.add_rigid(wf.Box((0.3 * k, 0, 0.0505 + 0.02 * k), (0.1, 0.1, 0.1)), mass=1.0)
        b.add_contact(box, b.add_collider(wf.HalfSpace((0, 0, 1))), mu=0.3)
        b.set_initial(box, velocity=(0, 0, -1), angular_velocity=(5 * k, 3, 0))
    wheel = b.add_rigid(wf.Cylinder((0, 4, 1), (0, 4.1, 1), 0.2), mass=1.0)
    b.add_joint("revolute", parent=wf.GROUND, child=wheel.at((0, 4, 1)), axis=(0, 1, 0))
    b.set_initial(wheel, angular_velocity=(0, 3.0, 0))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=5e-3, integrator="energy_momentum")
    before = sim.energies()["kinetic"][0]
    assert sim.step(10).converged.all()
    assert sim.time[0] == pytest.approx(0.05, rel=1e-12)
    assert 0.0 < sim.energies()["kinetic"][0] < before + 2 * 9.81 * 0.02  # no more than what the boxes fall
