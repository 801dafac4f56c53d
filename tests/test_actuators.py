"""Actuators, stops, friction and turns of joints against closed forms and equations of motion."""

from typing import Any

import numpy as np
import pytest
import warp as wp
from scipy.integrate import solve_ivp
from test_springs import forces

import warpfea as wf
from warpfea.terms.springs import Springs

TIGHT = {"solver": wf.NewtonPCG(tol=1e-12), "constraint_tol": 1e-12}
SCHEMES = ["backward_euler", "bdf2", "energy_momentum", "generalized_alpha"]


def rotor(rate: float = 1.0, gravity: Any = (0, 0, 0), com: float = 0.0, **options: Any) -> tuple[Any, Any, Any]:
    """A part of 1 kg m^2 about a hinge along z, its mass of 1 kg at `com` on the x axis."""
    b = wf.ModelBuilder(gravity=gravity)
    about = 1.0 - com**2
    part = b.add_rigid(wf.Box((com, 0, 0), (0.1, 0.2, 0.3)), mass=1.0, inertia=(about, about, about), name="part")
    joint = b.add_joint("revolute", parent=wf.GROUND, child=part.at((0, 0, 0)), axis=(0, 0, 1), name="hinge", **options)
    if rate:
        spin = np.array([0.0, 0.0, rate])
        b.set_initial(part, angular_velocity=spin, velocity=np.cross(spin, (com, 0, 0)))
    return b, part, joint


def slider(speed: float, **options: Any) -> tuple[Any, Any]:
    """A part of 2 kg on a slide along x."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    part = b.add_rigid(wf.Box((1, 0, 0), (0.1, 0.2, 0.3)), mass=2.0, name="slider")
    slide = b.add_joint("translational", parent=wf.GROUND, child=part.at((1, 0, 0)), axis=(1, 0, 0), name="slide",
                        **options)  # fmt: skip
    b.set_initial(part, velocity=(speed, 0, 0))
    return b, slide


def run(b: Any, dt: Any, scheme: str = "energy_momentum", **options: Any) -> Any:
    return wf.Simulation(b.finalize(device="cpu", **options), dt=dt, integrator=scheme, **TIGHT)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_torque_and_a_controller_drive_a_pendulum(scheme: str) -> None:
    """I y'' = T(t) + kp (target - y) - kd y' - m g l cos y, of the scheme's order; the ledger is closed."""

    def rate(t: float, y: np.ndarray) -> list[float]:
        torque = np.interp(t, [0, 0.2, 0.4], [0, 8.0, 3.0]) + 20.0 * (0.4 - y[0]) - 1.5 * y[1]
        return [y[1], torque - 9.81 * 0.5 * np.cos(y[0])]

    exact = solve_ivp(rate, (0, 0.4), [0.0, 2.0], rtol=1e-11, atol=1e-12, max_step=1e-2).y[:, -1]
    b, _, hinge = rotor(2.0, (0, -9.81, 0), com=0.5)
    b.add_actuator(hinge, ([0, 0.2, 0.4], [0, 8.0, 3.0]), name="torque")
    b.add_actuator(hinge, wf.PD(20.0, 1.5, target=0.4), name="pd")
    errors = []
    for h in (4e-3, 2e-3):
        sim = run(b, h, scheme)
        sim.run(0.4)
        errors.append(abs(sim.joint_value(hinge)[0] - exact[0]))
    assert errors[0] / errors[1] > (1.9 if scheme == "backward_euler" else 3.5), errors
    assert errors[1] < (1e-2 if scheme == "backward_euler" else 1e-4), errors
    assert sim.joint_rate(hinge)[0] == pytest.approx(exact[1], rel=0.02)
    e = {name: values[0] for name, values in sim.energies().items()}
    assert abs(e["ledger_residual"]) < 1e-9
    assert e["work"] == e["actuators"]
    gained = e["kinetic"] + e["potential"] - 2.0
    if scheme == "energy_momentum":
        assert e["actuators"] == pytest.approx(gained, abs=1e-9)


@pytest.mark.parametrize("scheme", ["backward_euler", "bdf2", "energy_momentum"])
@pytest.mark.parametrize("h", [1e-4, 1e-2, 0.1])
def test_a_stiff_controller_adds_no_energy(scheme: str, h: float) -> None:
    """kp = 1e9 on 1 kg m^2, target held: kinetic energy and kp y^2/2 together never grow, of BDF2 in its own norm."""
    b, _, hinge = rotor()
    b.add_actuator(hinge, wf.PD(1e9, target=wf.Control("q", 1)))
    sim = run(b, h, scheme)
    z = [np.array([1.0, 0.0])]
    for _ in range(20):
        assert sim.step().converged.all()
        z.append(np.array([sim.joint_rate(hinge)[0], np.sqrt(1e9) * sim.joint_value(hinge)[0]]))
    states = np.array(z)
    energy = 0.5 * (states**2).sum(axis=1)
    if scheme == "bdf2":
        energy = 0.25 * ((states[1:] ** 2).sum(axis=1) + ((2.0 * states[1:] - states[:-1]) ** 2).sum(axis=1))
    assert np.diff(energy).max() < 1e-8 * energy[0]
    if scheme == "energy_momentum":
        assert energy[-1] > 0.99 * energy[0]


def test_the_limit_of_a_controller() -> None:
    """A motor of 2 N m on 1 kg m^2 accelerates by 2 rad/s^2 whatever the gain, and one per world by its own."""
    b, _, hinge = rotor(0.0)
    b.add_actuator(hinge, wf.PD(1e6, 10.0, target=wf.Control("q", 1, initial=3.0), limit=2.0), name="motor")
    sim = run(b, 1e-2, worlds=2)
    sim.model.set_parameter("motor.limit", [2.0, 3.0])
    assert np.isnan(sim.spring_force("motor")).all()
    sim.run(1.0)
    np.testing.assert_allclose(sim.spring_force("motor"), [2.0, 3.0], rtol=1e-3)
    with pytest.raises(wf.ModelError, match="expected a spring of this model"):
        sim.spring_force("moter")
    np.testing.assert_allclose(sim.joint_value(hinge), [1.0, 1.5], rtol=1e-4)
    np.testing.assert_allclose(sim.joint_rate(hinge), [2.0, 3.0], rtol=2e-4)
    np.testing.assert_allclose(sim.energies()["actuators"], [2.0, 4.5], rtol=1e-4)


def test_a_stop_hit_at_10_m_per_s() -> None:
    """It is passed by v sqrt(m/k), and left at the speed of the impact."""
    b, slide = slider(10.0, limits=wf.Stop(-1.0, 0.2, stiffness=2e4))
    sim = run(b, 5e-4)
    travel = []
    for _ in range(200):
        sim.step()
        travel.append(sim.joint_value(slide)[0])
    assert max(travel) - 0.2 == pytest.approx(10.0 * np.sqrt(2.0 / 2e4), rel=1e-3)
    assert sim.joint_rate(slide)[0] == pytest.approx(-10.0, abs=1e-8)
    assert abs(sim.energies()["integrator"][0]) < 1e-8


@pytest.mark.parametrize(
    ("scheme", "h"),
    [("backward_euler", 5e-4), ("bdf2", 2.5e-4), ("energy_momentum", 1e-3), ("generalized_alpha", 2.5e-4)],
)
def test_a_damped_stop_hit_at_10_m_per_s(scheme: str, h: float) -> None:
    """Until k p + c dp/dt = 0 of the damped vibration p, wherever in a step it begins: speed, place and loss are of
    the scheme's order."""
    m, k, c, v = 2.0, 2e4, 60.0, 10.0
    decay = 0.5 * c / m
    w = np.sqrt(k / m - decay**2)
    t = np.arctan2(c * w, c * decay - k) / w
    depth = v / w * np.exp(-decay * t) * np.sin(w * t)
    speed = v * np.exp(-decay * t) * (np.cos(w * t) - decay / w * np.sin(w * t))
    assert k * depth + c * speed == pytest.approx(0.0, abs=1e-9)
    b, slide = slider(v, limits=wf.Stop(-1.0, 1.0, stiffness=k, damping=c))
    ends = v * h * (2.0 + np.array([0.125, 0.375, 0.625, 0.875]))
    errors = []
    for dt in (h, 0.5 * h, 0.25 * h):
        sim = run(b, dt, scheme, worlds=4)
        sim.model.set_parameter("slide.upper", ends)
        sim.run(0.036)
        place = ends + depth + speed * (0.036 - ends / v - t)
        losses = sim.energies()["spring_loss"] - 0.5 * m * (v**2 - speed**2)
        errors.append([np.abs(sim.joint_rate(slide) - speed).max(), np.abs(sim.joint_value(slide) - place).max(),
                       np.abs(losses).max()])  # fmt: skip
    ratios = np.array(errors[0]) / errors[1]
    assert ratios.min() > (1.8 if scheme == "backward_euler" else 3.5), errors
    bounds = [0.25, 8e-3, 3.0] if scheme == "backward_euler" else [3e-3, 1e-4, 0.05]
    assert (np.array(errors[1]) < bounds).all(), errors
    if scheme != "backward_euler":  # of the speed, the way and the energy before
        assert (np.array(errors[2]) < 1e-4 * np.array([v, 0.036 * v, 0.5 * m * v**2])).all(), errors
    if scheme == "bdf2":
        sim = wf.Simulation(b.finalize(device="cpu"), dt="auto", error=1e-4, integrator=scheme, **TIGHT)
        sim.model.set_parameter("slide.upper", ends[:1])
        sim.run(0.036)
        assert sim.joint_rate(slide) == pytest.approx(speed, abs=0.02)


def test_stops_by_default_take_most_of_the_speed() -> None:
    """(lower, upper) alone: the inertia of both bodies sets stiffness and damping, at any step."""
    for h, scheme in ((1e-3, "energy_momentum"), (2e-2, "backward_euler"), (2e-2, "bdf2")):
        b, _, hinge = rotor(5.0, limits=(-0.5, 0.3), com=0.5)
        sim = run(b, h, scheme)
        sim.step(round(0.2 / h))
        assert abs(sim.joint_rate(hinge)[0]) < 1.0
        assert abs(sim.joint_value(hinge)[0]) < 0.31
    stop = b.description.springs[0]
    assert stop.stiffness == pytest.approx((2.0 * np.pi / 0.01) ** 2)


def test_stops_never_throw_back() -> None:
    """A critically damped stop returns e^-2 of the speed; steps that do not resolve it return less, and none is refused
    or books a negative loss, wherever in a step the stop is met."""
    for h, least, most in ((2e-4, 0.13, np.exp(-2.0)), (1e-3, 0.08, 0.1), (2e-3, 0.05, 0.08), (1e-2, 0.0, 0.015)):
        for speed in (8.7, 9.4, 10.0, 10.6):
            b, slide = slider(speed, limits=(-10.0, 1.0))
            sim = run(b, h, "bdf2")
            losses = [0.0]
            for _ in range(round(1.0 / speed / h) + max(4, round(6e-3 / h))):
                sim.step()
                losses.append(sim.energies()["spring_loss"][0])
            assert least < -sim.joint_rate(slide)[0] / speed < most, (h, speed)
            assert min(np.diff(losses)) >= 0.0, (h, speed)
            assert losses[-1] < speed**2


def test_adaptive_steps_resolve_a_stop() -> None:
    """A critically damped stop hit at 10 rad/s: v t exp(-w t) until 2/w, then e^-2 of the speed. The requested error is
    kept, and ten times the accuracy takes about twice the substeps (by backward Euler: ten times, refused)."""
    b, _, hinge = rotor(10.0, limits=(-10.0, 0.2))
    exact = 0.2 + 10.0 * np.exp(-2.0) * (0.02 / np.pi - 0.01)
    for error in (1e-5, 1e-6):
        sim = wf.Simulation(b.finalize(device="cpu"), dt="auto", error=error, integrator="bdf2", **TIGHT)
        sim.run(0.03)
        assert abs(sim.joint_value(hinge)[0] - exact) < error
        assert sim.totals["substeps"][0] < 2.4 / np.sqrt(error)


def test_a_load_just_below_the_friction_is_held() -> None:
    """Friction of 1.01 times a load that acts at once: the joint rests on its stick spring, 1e-4 rad / 1.01, whose
    damper takes half of the load's work; that of the spring alone, without slip, is no loss."""
    for scheme in ("bdf2", "energy_momentum"):
        b, _, hinge = rotor(0.0, (0, -9.81, 0), com=0.5, friction=1.01 * 4.905)
        sim = run(b, 2e-3, scheme)
        sim.step(500)
        assert sim.joint_value(hinge)[0] == pytest.approx(-1e-4 / 1.01, rel=1e-3)
        assert sim.energies()["spring_loss"][0] == pytest.approx(0.5 * 4.905e-4 / 1.01, rel=0.02)
        sim.step(100)
        assert sim.joint_value(hinge)[0] == pytest.approx(-1e-4 / 1.01, rel=1e-4)
        assert sim.spring_force("hinge.friction")[0] == pytest.approx(4.905, rel=1e-4)


def test_friction_sticks_and_slips() -> None:
    """A beam under its weight, of 4.905 N m: friction of 10 N m, twice the sudden load, holds it within the stick's
    1e-4 rad, without creep; one of 3 N m is taken from the acceleration. A flywheel stops, and stays."""
    for scheme in ("backward_euler", "energy_momentum"):
        b, _, hinge = rotor(0.0, (0, -9.81, 0), com=0.5, friction=10.0)
        sim = run(b, 1e-2, scheme, worlds=2)
        sim.model.set_parameter("hinge.friction", [10.0, 3.0])
        sim.step(10)
        angles = sim.joint_value(hinge)
        assert angles[1] == pytest.approx(-0.5 * 1.905 * 0.1**2, rel=0.1)
        sim.step(100)
        held = sim.joint_value(hinge)[0]
        sim.step(100)
        assert sim.joint_value(hinge)[0] == pytest.approx(held, rel=1e-3)
        assert held == pytest.approx(-0.4905e-4, rel=1e-3)
    b, _, hinge = rotor(1.0, friction=2.0)
    sim = run(b, 2e-3)
    sim.step(240)
    assert sim.joint_value(hinge)[0] == pytest.approx(0.48 - 0.48**2, abs=1e-3)
    sim.step(400)
    assert sim.joint_value(hinge)[0] == pytest.approx(0.25, abs=2e-4)
    assert abs(sim.joint_rate(hinge)[0]) < 1e-5
    e = sim.energies()
    assert e["spring_loss"][0] == pytest.approx(0.5, rel=1e-6)
    assert abs(e["integrator"][0]) < 1e-9


def test_a_shorter_stick_leads_to_coulombs_place() -> None:
    """On a spring a slide turns round where it leaves 2 F/k of its swing, until k x < F: off by less than the stick."""
    force, k, speed = 1.0, 50.0, 0.9
    place = np.hypot(force / k, speed * np.sqrt(2.0 / k)) - force / k
    while k * abs(place) > force:
        place = -np.sign(place) * (abs(place) - 2.0 * force / k)
    for stick in (1e-2, 1e-5):
        b, slide = slider(speed, friction=wf.Friction(force, stick=stick), stiffness=k)
        sim = wf.Simulation(b.finalize(device="cpu"), dt=2e-3, integrator="bdf2")
        sim.run(3.5)
        assert abs(sim.joint_value(slide)[0] - place) < stick + 1.5e-5, (stick, sim.joint_value(slide), place)
        held = int(sim.totals["newton"][0])
        sim.step(50)
        assert int(sim.totals["newton"][0]) - held <= 60  # friction and spring, which cancel, set the scale


def test_a_driven_joint_with_stiffness_and_damping() -> None:
    """J q'' + c q' + k q = T(t), T linear between samples: of second order, 1e-4 of the amplitude at h = 5e-3 s."""
    times, torque = [0.0, 0.5, 1.0, 1.5], [0.0, 6.0, -4.0, 0.0]

    def rate(t: float, q: Any) -> list[float]:
        return [q[1], np.interp(t, times, torque) - 0.5 * q[1] - 9.0 * q[0]]

    exact = solve_ivp(rate, (0, 1.5), [0.0, 2.0], rtol=1e-10, atol=1e-12, max_step=0.01).y[0, -1]
    errors = []
    for h in (1e-2, 5e-3):
        b, _, hinge = rotor(2.0, stiffness=9.0, damping=0.5)
        b.add_actuator(hinge, (times, torque))
        sim = run(b, h)
        sim.run(1.5)
        errors.append(abs(sim.joint_value(hinge)[0] - exact))
    assert errors[1] < 1e-4, errors
    assert errors[0] > 3.5 * errors[1], errors


def test_undriven_angles_count_turns() -> None:
    b, _, hinge = rotor(20.0, stiffness=0.25, damping=0.0)
    sim = run(b, 5e-3)
    seen = sim.observe("joint.hinge.angle", "joint.hinge.angle_rate")
    sim.step(100)
    exact = np.array([40.0 * np.sin(0.25), 20.0 * np.cos(0.25)])
    got = np.array([sim.joint_value(hinge)[0], sim.joint_rate(hinge)[0]])
    np.testing.assert_allclose(got, exact, rtol=2e-3)
    np.testing.assert_allclose(seen.update().numpy()[0], got, rtol=1e-12)


@pytest.mark.parametrize(("turns", "rate"), [(2, 1e-12), (100, 1e-10)])
@pytest.mark.parametrize("scheme", ["backward_euler", "bdf2"])
def test_a_controlled_part_comes_to_rest_at_whole_turns(scheme: str, turns: int, rate: float) -> None:
    """Displacements, forces and energies vanish; the angle of all turns keeps its round-off, beside a stop there."""
    whole, t = 2.0 * np.pi * turns, 0.1 * turns
    b, _, hinge = rotor(0.0, limits=(-1.0, whole + 1e-3) if turns > 2 else None)
    b.add_actuator(hinge, wf.PD(1e4, 200.0, target=([0.0, t, t + 0.1], [0.0, whole, whole])))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-2, integrator=scheme)
    sim.run(t + 1.3)
    np.testing.assert_allclose(sim.joint_value(hinge), whole, rtol=1e-15)
    assert abs(sim.joint_rate(hinge)[0]) < rate


@pytest.mark.parametrize("scheme", ["backward_euler", "bdf2"])
def test_a_held_part_passes_each_change_of_its_load_on(scheme: str) -> None:
    """Nothing moves: multipliers alone change from step to step, also where the penalty has balanced the change."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    part = b.add_rigid(wf.Box((0, 0, -0.5), (0.1, 0.1, 1)), mass=1.0, name="part")
    joint = b.add_joint("fixed", parent=wf.GROUND, child=part.at((0, 0, 0)), name="joint")
    b.add_point_load(part.at((0, 0, -0.5)), wf.Control("F", 3))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=0.1, integrator=scheme)
    for step in range(1, 12):
        sim.controls["F"] = (0, 0, -step / 0.7)
        sim.step()
        np.testing.assert_allclose(sim.joint_force(joint)[0, 2], step / 0.7, rtol=1e-6)


def test_joint_forces_of_statics_carry_every_load_step() -> None:
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    part = b.add_rigid(wf.Box((0, 0, -0.5), (0.1, 0.1, 1)), mass=1.0, name="part")
    joint = b.add_joint("revolute", parent=wf.GROUND, child=part.at((0, 0, 0)), axis=(0, -1, 0), name="joint")
    b.add_actuator(joint, wf.PD(100.0, 1.0))
    model = b.finalize(device="cpu")
    for load_steps in (3, 11):
        result = wf.solve_static(model, load_steps=load_steps)
        np.testing.assert_allclose(result.joint_force(joint)[0, 2], 9.81, rtol=1e-8)


def test_controllers_hold_in_statics() -> None:
    """The beam hangs down by its weight over kp; a torque alone does not hold it."""
    b, _, hinge = rotor(0.0, (0, -9.81, 0), com=0.5)
    b.add_actuator(hinge, 1.0)
    with pytest.raises(wf.ModelError, match="1 unconstrained"):
        wf.solve_static(b.finalize(device="cpu"))
    motor = b.add_actuator(hinge, wf.PD(100.0, 5.0, target=wf.Control("q", 1, initial=0.1)))
    static = wf.solve_static(b.finalize(device="cpu"), load_steps=1, tol=1e-12)
    y = static.joint_value(hinge)[0]
    assert 100.0 * (0.1 - y) + 1.0 == pytest.approx(4.905 * np.cos(y), rel=1e-9)
    assert static.spring_force(motor)[0] == pytest.approx(100.0 * (0.1 - y), rel=1e-9)


def mixed() -> tuple[Any, Any]:
    """A pendulum on a slide with every law at work."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    cart = b.add_rigid(wf.Box((0, 0, 0), (0.2, 0.1, 0.1)), mass=2.0, name="cart")
    arm = b.add_rigid(wf.Box((0.25, 0, 0), (0.5, 0.05, 0.05)), mass=1.0, name="arm")
    slide = b.add_joint("translational", parent=wf.GROUND, child=cart.at((0, 0, 0)), axis=(1, 0, 0), name="slide",
                        limits=wf.Stop(-0.05, 0.02, stiffness=3e3, damping=5.0), friction=1.0)  # fmt: skip
    hinge = b.add_joint("revolute", parent=cart.at((0, 0, 0)), child=arm.at((0, 0, 0)), axis=(0, 1, 0), name="hinge",
                        limits=wf.Stop(-1.0, 0.4, stiffness=50.0, damping=0.1), friction=0.1, stiffness=1.0,
                        damping=0.05)  # fmt: skip
    b.add_actuator(slide, wf.PD(100.0, 3.0, target=wf.Control("q", 1), limit=15.0), name="pd")
    b.add_actuator(hinge, ([0.0, 1.0], [0.5, -1.0]), name="torque")
    return b, hinge


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_worlds_and_checkpoints_are_bit_equal(dtype: str, tmp_path: Any) -> None:
    b, hinge = mixed()
    sims = {n: wf.Simulation(b.finalize(device="cpu", dtype=dtype, worlds=n), dt=5e-3, integrator="bdf2")
            for n in (1, 3)}  # fmt: skip
    many, one = sims[3], sims[1]
    many.model.set_parameter("pd.kp", [80.0, 100.0, 120.0])
    many.controls["q"][:] = [0.1, 0.3, -0.2]
    one.controls["q"][:] = 0.3
    for sim in (many, one):
        sim.step(40)
    assert np.array_equal(many.state.displacement.numpy()[1], one.state.displacement.numpy()[0])
    assert len({float(x) for x in many.joint_value(hinge)}) == 3
    many.run(0.3, outputs=[wf.Checkpoint(str(tmp_path / "c.npz"))])
    again = wf.Simulation(many.model, dt=5e-3, integrator="bdf2")
    again.resume(str(tmp_path / "c.npz"))
    for sim in (many, again):
        sim.step(20)
    for name, values in many.state.numpy().items():
        assert np.array_equal(values, again.state.numpy()[name], equal_nan=True), name


@pytest.mark.parametrize("scheme", ["backward_euler", "energy_momentum"])
def test_forces_products_and_energies_agree(scheme: str) -> None:
    """Forces are derivatives of the rows, products of forces; the discrete gradient takes what the ledger says."""
    b, _ = mixed()
    model = b.finalize(device="cpu")
    for seed in range(4):
        sim = wf.Simulation(model, dt=1e-2, integrator=scheme)
        rng = np.random.default_rng(seed)
        ctx, term, w = sim.stepper.ctx, model.terms.find(Springs), sim.stepper.work
        shape = (1, model.slots, 3)
        ctx.state.displacement.assign(rng.normal(scale=3e-2, size=shape))
        w.q_tilde.assign(ctx.state.displacement.numpy())
        w.step.dq_dv.fill_(5e-3 if scheme == "energy_momentum" else 1e-2)
        w.step.h.fill_(1e-2)
        w.step.a0.fill_(1.0)
        active = wp.ones(1, dtype=wp.int32, device="cpu")
        w.time_law_stage_values.assign(rng.normal(scale=0.2, size=w.time_law_stage_values.numpy().shape))
        term.begin(ctx, active)
        u = ctx.state.displacement.numpy()[0] + rng.normal(scale=1e-2, size=shape[1:])
        d = rng.normal(size=u.shape)
        start = ctx.state.displacement.numpy()[0]
        before = term.stored_energy(ctx)["springs"][0]
        term.begin(ctx, active)
        near = [forces(sim, term, active, u + s * 1e-6 * d) for s in (-1, 1)]
        f, _ = forces(sim, term, active, u)
        w.p.assign(d[None])
        term.product(ctx, w.p, active)
        product = np.zeros_like(u)
        np.add.at(product, term.entry_slot, w.pool_product.numpy()[0, term.offset :][: len(term.entry_slot)])
        expected = (near[1][0] - near[0][0]) / 2e-6
        assert np.abs(product - expected).max() < 1e-5 * np.abs(expected).max()
        rows = term.energy_increments(ctx, active).numpy()[:, 0].sum(axis=1)
        if scheme == "backward_euler":
            assert (f * d).sum() == pytest.approx((near[1][1] - near[0][1]) / 2e-6, rel=1e-5)
        else:
            assert (f * (u - start)).sum() == pytest.approx(rows[0] - before + rows[1] - rows[2], rel=1e-9)
            assert rows[1] > 0.0


def test_bad_input_is_named() -> None:
    b, part, hinge = rotor()
    ball = b.add_joint("spherical", parent=wf.GROUND, child=part.at((0.1, 0, 0)), name="ball")
    driven = b.add_joint("revolute", parent=wf.GROUND, child=part.at((0, 0, 0.1)), axis=(0, 0, 1), drive=0.5, name="d")
    cases: list[tuple[Any, str]] = [
        (lambda: wf.Stop(0.3, -0.3), "wrong way round"),
        (lambda: wf.Stop(0.3, 0.3), "at one place"),
        (lambda: wf.Stop(None, 0.3), "must be two numbers; inf is no end"),  # type: ignore[arg-type]
        (lambda: wf.Stop(0.0, 1.0, stiffness=-1.0), "stiffness = -1.0"),
        (lambda: wf.PD(-1.0), "kp = -1.0"),
        (lambda: wf.PD(1.0, kd=np.nan), "kd = nan"),
        (lambda: wf.PD(1.0, limit=0.0), "limit = 0.0"),
        (lambda: wf.Friction(1.0, stick=0.0), "wf.Friction: stick = 0.0 must be a positive number, rad or m"),
        (lambda: b.add_actuator(ball, 1.0), "spherical joint has no angle"),
        (lambda: b.add_actuator("hing", 1.0), "no joint of this builder"),
        (lambda: b.add_actuator(driven, 1.0), "is driven"),
        (lambda: b.add_actuator(hinge, wf.PD(1.0, target=wf.Control("q", 3))), "control 'q' has size 3"),
        (lambda: b.add_joint("revolute", parent=wf.GROUND, child=part.at((0, 0, 0)), axis=(0, 0, 1), friction=-2.0),
         "friction = -2.0"),
        (lambda: b.add_joint("revolute", parent=wf.GROUND, child=part.at((0, 0, 0)), axis=(0, 0, 1), limits=0.3),
         "must be \\(lower, upper\\)"),
        (lambda: b.add_joint("revolute", parent=wf.GROUND, child=part.at((0, 0, 0)), axis=(0, 0, 1), limits=(0.1, 0.2)),
         "leave out the reference"),
        (lambda: b.add_joint("revolute", parent=wf.GROUND, child=part.at((0, 0, 0)), axis=(0, 0, 1), friction=1e300),
         "friction = 1e\\+300 is too large"),
        (lambda: b.add_joint("spherical", parent=wf.GROUND, child=part.at((0, 0, 0)), damping=1.0), "no angle"),
    ]  # fmt: skip
    for call, text in cases:
        with pytest.raises(wf.ModelError, match=text):
            call()
    assert len(b.description.joints) == 4
    assert not b.description.springs
    b, _, hinge = rotor(limits=(-1.0, 1.0), friction=1.0)
    b.add_actuator(hinge.name, wf.PD(1.0, limit=2.0), name="pd")
    with pytest.raises(wf.ModelError, match="'hing' is no joint of this builder; did you mean 'hinge'"):
        b.add_actuator("hing", 1.0)
    model = b.finalize(device="cpu")
    for name, value, text in (
        ("pd.kp", -1.0, "set_parameter: pd.kp = -1.0 in world 0 must be 0 or more"),
        ("hinge.lower", 2.0, "set_parameter: hinge.lower = 2.0 in world 0 must be below the upper"),
        ("pd.limit", 0.0, "pd.limit = 0.0 in world 0 must be positive"),
        ("hinge.friction", 1e300, "hinge.friction = 1e\\+300 in world 0 must be 0 to 1e\\+100"),
    ):
        with pytest.raises(wf.ModelError, match=text):
            model.set_parameter(name, value)


@pytest.mark.cuda
@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("scheme", ["bdf2", "energy_momentum"])
def test_both_devices_agree(scheme: str, dtype: str) -> None:
    """Every law at work, in two worlds."""
    b, hinge = mixed()
    found = []
    for device in ("cpu", "cuda:0"):
        sim = wf.Simulation(b.finalize(device=device, dtype=dtype, worlds=2), dt=5e-3, integrator=scheme)
        sim.controls["q"][:] = [0.1, -0.2]
        sim.step(40)
        found.append([sim.joint_value(hinge), sim.joint_rate(hinge), sim.energies()["actuators"]])
    np.testing.assert_allclose(found[1], found[0], rtol=1e-5 if dtype == "float64" else 2e-2)


def test_a_contrast_that_float32_can_not_solve_is_named_soon() -> None:
    """Twelve links on motors of 1.4e9 N m/rad: without factors of the whole, conjugate gradients end at round-off."""
    b = wf.ModelBuilder()
    parent: Any = wf.GROUND
    for k in range(12):
        link = b.add_rigid(wf.Box((0.1 * k + 0.05, 0, 0), (0.1, 0.03, 0.03)), mass=1.0)
        joint = b.add_joint("revolute", parent=parent, child=link.at((0.1 * k, 0, 0)), axis=(0, 1, 0), name=f"j{k}")
        b.add_actuator(joint, wf.PD(1.44e9, 2.88e8), name=f"m{k}")
        parent = link.at((0.1 * (k + 1), 0, 0))
    solver = wf.NewtonPCG(preconditioner="two-level", operator="elements")
    sim = wf.Simulation(b.finalize(device="cpu", dtype="float32"), dt=1e-2, solver=solver, integrator="bdf2")
    with pytest.raises(wf.ConvergenceError, match=r"float32 round-off limit.*use float64"):
        sim.step()
    assert sim.last is not None
    assert sim.last.pcg[0] <= 5 * solver.max_pcg  # of 200 000
