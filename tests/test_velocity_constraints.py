"""Constraints at the level of velocities against equations of motion: sleigh, rolling disc, motor."""

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import warpfea as wf

TIGHT = {"solver": wf.NewtonPCG(tol=1e-12), "constraint_tol": 1e-12}
SCHEMES = ["backward_euler", "bdf2", "energy_momentum"]


def run(b: Any, dt: Any, scheme: str, **options: Any) -> Any:
    return wf.Simulation(b.finalize(device="cpu", **options), dt=dt, integrator=scheme, **TIGHT)


def check_order(scheme: str, errors: list[float], bound: float) -> None:
    order = 1 if scheme == "backward_euler" else 2
    assert errors[0] / errors[1] > 0.9 * 2**order, errors
    assert errors[1] < (100.0 * bound if order == 1 else bound), errors


def sleigh() -> tuple[Any, Any]:
    """Chaplygin's: the centre of mass 0.3 m ahead of the knife's edge, which turns it until it runs straight."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    part = b.add_rigid(wf.Box((0.3, 0, 0), (0.6, 0.2, 0.1)), mass=2.0, inertia=(0.3, 0.4, 0.5), com=(0.3, 0, 0))
    b.add_velocity_constraint("knife", part.at((0, 0, 0)), axis=(0, 1, 0), name="knife")
    b.set_initial(part, velocity=(0.4, 0.45, 0), angular_velocity=(0, 0, 1.5))
    return b, part


@pytest.mark.parametrize("scheme", SCHEMES)
def test_chaplygins_sleigh(scheme: str) -> None:
    """v' = a w^2, (I + m a^2) w' = -m a v w along the sleigh; no motion across it at the velocity of the scheme."""

    def rate(_: float, y: np.ndarray) -> list[float]:
        v, w = y[3:]
        return [v * np.cos(y[2]), v * np.sin(y[2]), w, 0.3 * w * w, -2.0 * 0.3 * v * w / 0.68]

    exact = solve_ivp(rate, (0, 1), [0, 0, 0, 0.4, 1.5], rtol=1e-11, atol=1e-12).y[:, -1]
    centre = exact[:2] + 0.3 * np.array([np.cos(exact[2]), np.sin(exact[2])])
    errors = []
    b, part = sleigh()
    for h in (1e-2, 5e-3):
        sim = run(b, h, scheme)
        sim.run(1.0)
        errors.append(float(np.linalg.norm(sim.pose(part)[0][0, :2] - centre)))
    check_order(scheme, errors, 1e-4)
    assert sim.violation("knife")[0] < 1e-12
    # the force turns the sleigh: m times the acceleration across it
    across = sim.joint_force("knife")[0, :3]
    v, w = exact[3:]
    assert np.linalg.norm(across) == pytest.approx(2.0 * (v * w - 0.3 * 2.0 * 0.3 * v * w / 0.68), rel=0.03)
    e = sim.energies()
    assert abs(e["ledger_residual"][0]) < 1e-10
    if scheme == "energy_momentum":
        assert abs(e["kinetic"][0] - 0.925) < 1e-11


RADIUS, SPIN = 0.2, np.array([0.0, 4.0, 1.0])


def disc(lean: float) -> tuple[Any, Any, np.ndarray]:
    """A thin disc that leans by an angle about x, and rolls along x."""
    e = np.array([0.0, np.cos(lean), np.sin(lean)])
    up = np.array([0.0, -np.sin(lean), np.cos(lean)])
    centre = RADIUS * up
    axes = np.stack([np.array([1.0, 0, 0]), e, up], axis=1)
    inertia = axes @ np.diag([0.02, 0.04, 0.02]) @ axes.T
    b = wf.ModelBuilder()
    part = b.add_rigid(wf.Cylinder(centre - 0.005 * e, centre + 0.005 * e, RADIUS), mass=2.0, inertia=inertia,
                       com=centre, name="disc")  # fmt: skip
    b.add_velocity_constraint("roll", part.at(centre), axis=e, radius=RADIUS, name="roll")
    b.set_initial(part, velocity=np.cross(SPIN, centre), angular_velocity=SPIN)
    return b, part, e


def rolling(e: np.ndarray, t_end: float) -> tuple[np.ndarray, np.ndarray]:
    """Centre and axis of a rolling disc by the balance of moments about its lowest point."""
    n, m, g = np.array([0.0, 0, 1]), 2.0, 9.81

    def arm(axis: np.ndarray) -> np.ndarray:
        up = n - (n @ axis) * axis
        return RADIUS * up / np.linalg.norm(up)

    def rate(_: float, y: np.ndarray) -> np.ndarray:
        e, w = y[3:6], y[6:9]
        de = np.cross(w, e)
        r, step = arm(e), 1e-6
        dr = (arm(e + step * de) - arm(e - step * de)) / (2.0 * step)
        inertia = 0.02 * np.eye(3) + 0.02 * np.outer(e, e)
        about = inertia + m * (r @ r * np.eye(3) - np.outer(r, r))
        moment = -np.cross(w, inertia @ w) - m * np.cross(r, np.cross(w, dr) + g * n)
        return np.concatenate([np.cross(w, r), de, np.linalg.solve(about, moment)])

    y = solve_ivp(rate, (0, t_end), np.concatenate([arm(e), e, SPIN]), rtol=1e-10, atol=1e-12).y[:, -1]
    return y[:3], y[3:6]


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_rolling_disc(scheme: str) -> None:
    """Leaning by 0.2 rad it runs on a curve; its height follows from its lean, and the energy is kept."""
    b, part, e = disc(0.2)
    centre, _ = rolling(e, 0.5)
    errors = []
    for h in (2.5e-3, 1.25e-3):
        sim = run(b, h, scheme)
        sim.run(0.5)
        place = sim.pose(part)[0][0]
        errors.append(float(np.linalg.norm(place - centre)))
        x, y, z, w = sim.pose(part)[1][0]
        turned = e + 2.0 * np.cross((x, y, z), np.cross((x, y, z), e) + w * e)
        assert abs(place[2] - RADIUS * np.sqrt(1.0 - turned[2] ** 2)) < 1e-11
    check_order(scheme, errors, 1e-4)
    if scheme == "energy_momentum":
        energies = sim.energies()
        start = 0.5 * 2.0 * np.cross(SPIN, 0.2 * np.array([0, -np.sin(0.2), np.cos(0.2)])) @ np.cross(
            SPIN, 0.2 * np.array([0, -np.sin(0.2), np.cos(0.2)])
        ) + 0.5 * (0.02 * SPIN @ SPIN + 0.02 * (SPIN @ e) ** 2)
        lost = start + 2.0 * 9.81 * (RADIUS * np.cos(0.2) - place[2]) - energies["kinetic"][0]
        assert abs(lost) < 1e-5 * energies["kinetic"][0]  # the height's row is not quadratic


def test_a_wheel_stands_still() -> None:
    """On a plane and below one, at default tolerances: its height is known to the round-off of the radius alone."""
    for scheme, h, up in (("bdf2", 1e-3, 1.0), ("bdf2", 1e-2, 1.0), ("backward_euler", 1e-3, -1.0)):
        b = wf.ModelBuilder(gravity=(0, 0, -9.81))
        wheel = b.add_rigid(wf.Cylinder((0, -0.01, 0.2 * up), (0, 0.01, 0.2 * up), 0.2), mass=2.0)
        b.add_velocity_constraint("roll", wheel.at((0, 0, 0.2 * up)), axis=(0, 1, 0), radius=0.2, normal=(0, 0, up),
                                  name="roll")  # fmt: skip
        sim = wf.Simulation(b.finalize(device="cpu"), dt=h, integrator=scheme)
        sim.step(30)
        assert sim.joint_force("roll")[0, 2] == pytest.approx(2.0 * 9.81, rel=1e-6)
        assert np.abs(sim.velocities(wheel)).max() < 1e-8


def test_a_wheel_rolls_alike_at_any_speed() -> None:
    """By 0.2 rad a step at 1 m/s and at 1e-5 m/s, in steps of 2e4 s: only the unit of time differs."""
    found = []
    for v in (1.0, 1e-5):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        wheel = b.add_rigid(wf.Cylinder((0, -0.1, 1), (0, 0.1, 1), 1.0), mass=1.0, inertia=(0.3, 0.5, 0.3))
        b.add_velocity_constraint("roll", wheel.at((0, 0, 1)), axis=(0, 1, 0), radius=1.0)
        b.set_initial(wheel, velocity=(v, 0, 0), angular_velocity=(0, v, 0))
        sim = wf.Simulation(b.finalize(device="cpu"), dt=0.2 / v, integrator="bdf2")
        found.append((sum(int(sim.step().newton[0]) for _ in range(30)), sim.pose(wheel)[0][0]))
    assert found[1][0] <= found[0][0] + 2 < 120
    assert np.abs(found[1][1] - found[0][1]).max() < 1e-9


def motor(**options: Any) -> tuple[Any, Any]:
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    part = b.add_rigid(wf.Box((0, 0, 0), (0.1, 0.2, 0.3)), mass=1.0, inertia=(1.0, 1.0, 1.0), name="part")
    hinge = b.add_joint("revolute", parent=wf.GROUND, child=part.at((0, 0, 0)), axis=(0, 0, 1), name="hinge")
    b.add_velocity_constraint("speed", hinge, name="motor", **options)
    return b, hinge


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_motor_of_given_speed(scheme: str) -> None:
    """3 t rad/s on 1 kg m^2: 1.5 rad and 3 N m after 1 s; the work is the energy."""
    b, hinge = motor(value=([0, 1], [0, 3.0]))
    sim = run(b, 1e-2, scheme)
    sim.run(1.0)
    assert sim.joint_value(hinge)[0] == pytest.approx(1.5, rel=2e-2 if scheme == "backward_euler" else 1e-4)
    assert sim.joint_rate(hinge)[0] == pytest.approx(3.0, rel=1e-3)
    assert sim.joint_force("motor")[0, 5] == pytest.approx(3.0, rel=0.1 if scheme == "backward_euler" else 1e-2)
    e = sim.energies()
    assert e["work_joints"][0] + (-e["integrator"][0]) == pytest.approx(e["kinetic"][0], abs=1e-9)


def test_worlds_controls_adaptive_steps_and_checkpoints(tmp_path: Any) -> None:
    b, hinge = motor(value=wf.Control("rate", 1, initial=1.0))
    many, one = (wf.Simulation(b.finalize(device="cpu", worlds=n), dt=1e-2, integrator="bdf2") for n in (3, 1))
    many.controls["rate"][:] = [0.5, 2.0, -1.0]
    one.controls["rate"] = 2.0
    for sim in (many, one):
        sim.run(0.2)
    np.testing.assert_allclose(many.joint_rate(hinge), [0.5, 2.0, -1.0], rtol=1e-6)
    assert np.array_equal(many.state.displacement.numpy()[1], one.state.displacement.numpy()[0])
    many.run(0.3, outputs=[wf.Checkpoint(str(tmp_path / "c.npz"))])
    again = wf.Simulation(many.model, dt=1e-2, integrator="bdf2")
    again.resume(str(tmp_path / "c.npz"))
    for sim in (many, again):
        sim.step(10)
    for name, values in many.state.numpy().items():
        assert np.array_equal(values, again.state.numpy()[name], equal_nan=True), name
    b, part = sleigh()
    auto = wf.Simulation(b.finalize(device="cpu"), dt="auto", error=1e-4, integrator="bdf2")
    auto.run(1.0)
    fine = run(b, 2e-3, "energy_momentum")
    fine.run(1.0)
    assert np.linalg.norm(auto.pose(part)[0] - fine.pose(part)[0]) < 3e-4


def test_what_is_refused() -> None:
    b, part = sleigh()
    with pytest.raises(wf.ModelError, match="'knife': statics has no velocities"):
        wf.solve_static(b.finalize(device="cpu"))
    with pytest.raises(wf.ModelError, match="'knife': modes are motions of positions"):
        wf.modes(b.finalize(device="cpu"))
    with pytest.raises(wf.ModelError, match="'knife': generalized_alpha"):
        wf.Simulation(b.finalize(device="cpu"), dt=1e-2, integrator="generalized_alpha")
    cases: list[tuple[Any, str]] = [
        (lambda: b.add_velocity_constraint("rolls", part.at((0, 0, 0))), "kind"),
        (lambda: b.add_velocity_constraint("roll", part.at((0, 0, 0)), axis=(0, 1, 0)), "missing radius="),
        (lambda: b.add_velocity_constraint("roll", part.at((0, 0, 0)), axis=(0, 0, 1), radius=1.0), "lies flat"),
        (lambda: b.add_velocity_constraint("roll", part.at((0, 0, 0)), axis=(0, 1, 0), radius=-1.0), "radius = -1.0"),
        (lambda: b.add_velocity_constraint("knife", part.at((0, 0, 0))), "missing axis="),
        (lambda: b.add_velocity_constraint("speed", part), "no joint of this builder"),
        (lambda: b.add_velocity_constraint("knife", part.at((0, 0, 0)), axis=(0, 1, 0), value=1.0), "is for a speed"),
        (lambda: b.add_velocity_constraint("knife", part.at((0, 0, 0)), axis=(0, 1, 0), normal=(0, 0, 1)), "no normal"),
    ]
    for call, text in cases:
        with pytest.raises(wf.ModelError, match=text):
            call()


@pytest.mark.cuda
@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("scheme", ["bdf2", "energy_momentum"])
def test_both_devices_agree(scheme: str, dtype: str) -> None:
    """A rolling disc and a motor, in two worlds."""
    b, part, _ = disc(0.2)
    found = []
    for device in ("cpu", "cuda:0"):
        sim = wf.Simulation(b.finalize(device=device, dtype=dtype, worlds=2), dt=5e-3, integrator=scheme)
        sim.step(40)
        found.append(sim.pose(part)[0])
    np.testing.assert_allclose(found[1], found[0], atol=1e-6 if dtype == "float64" else 1e-3)
