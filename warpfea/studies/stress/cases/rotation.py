"""Free spinning bodies, against Euler's equations and the scheme's action on a rigid rotor."""

from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation as Turn

import warpfea as wf

from ..build import StepStats, finalize, step
from ..case import Answer, Setting, case

BOX = np.array([0.3, 0.2, 0.1])


def _spinning_box(spin: Any, E: float) -> wf.ModelBuilder:
    """A stiff free box about the origin with angular velocity `spin`, rad/s; probes "y+" and "y-"."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    law = wf.SVK(E=E, nu=0.3, density=1000.0)
    body = b.add_solid(wf.mesh.box(tuple(BOX), cells=(1, 1, 1), origin=-BOX / 2), material=law)
    b.set_initial(body, angular_velocity=spin)
    for side in ("y+", "y-"):
        b.add_probe(side, body.surface(side))
    return b


def _momenta(sim: wf.Simulation) -> tuple[np.ndarray, np.ndarray]:
    """Linear and angular momentum (3,) of the only body, N s and N m s."""
    (body,) = sim.model.bodies
    u, v = (a.numpy()[0].astype(float) for a in (sim.state.displacement, sim.state.velocity))
    p = sim.model.mass_matrix()[::3, ::3] @ v
    return p[body.slot_kind == 0].sum(axis=0), np.cross(body.reference + u, p).sum(axis=0)


@case("dzhanibekov", "Rotation", quick="float64")
def dzhanibekov(setting: Setting) -> Answer:
    """A box spinning about its intermediate axis turns over; 3 s of BDF2 with steps of 1 ms, 3 turns of the box.

    Criterion: direction of that axis, initially 1 % off.
    """
    spin = 2.0 * np.pi * np.array([0.01, 1.0, 0.01])
    sim, stats = step(_spinning_box(spin, 1e8), setting, 3000, dt=1e-3, integrator="bdf2")
    got = sim.probe("y+").position[0] - sim.probe("y-").position[0]
    got /= np.linalg.norm(got, axis=1, keepdims=True)
    inertia = np.array([BOX[1] ** 2 + BOX[2] ** 2, BOX[0] ** 2 + BOX[2] ** 2, BOX[0] ** 2 + BOX[1] ** 2])

    def rates(_: float, y: np.ndarray) -> np.ndarray:
        w, q = y[:3], y[3:]  # spin in the body's axes; quaternion (x, y, z, w) of body to space
        rotating_bar = 0.5 * np.append(q[3] * w + np.cross(q[:3], w), -q[:3] @ w)
        return np.append(np.cross(inertia * w, w) / inertia, rotating_bar)

    times = sim.probe("y+").time
    exact = solve_ivp(rates, (0.0, times[-1]), [*spin, 0.0, 0.0, 0.0, 1.0], t_eval=times, rtol=1e-11, atol=1e-12)
    axis = Turn.from_quat(exact.y[3:].T).apply((0.0, 1.0, 0.0))
    error = float(np.linalg.norm(got - axis, axis=1).max())
    return Answer(error, 0.02, "Euler's equations by scipy", **stats.answer_fields,
                  limits={"halvings": (stats.halvings, 0.01 * sim.steps)},
                  note=f"the axis points to {axis[:, 1].min():.3f} of its first direction")  # fmt: skip


@case("spin", "Rotation", values=("backward_euler", "bdf2"), quick="both")
def spin(setting: Setting, integrator: str) -> Answer:
    """A stiff box spins 100 steps at omega h = 0.05: momentum and energy as of a rigid rotor under the scheme.

    The scheme moves a point of a rigid rotor to its free position, projected radially onto its circle.
    """
    omega, h, steps = 10.0, 5e-3, 100
    b, tol = _spinning_box((0.0, 0.0, omega), 1e8 if setting.single else 1e10), None if setting.single else 1e-10
    sim = wf.Simulation(finalize(b, setting), dt=h, integrator=integrator, solver=wf.NewtonPCG(tol=tol))
    start = _momenta(sim)[1][2]
    kinetic = 0.5 * omega * start
    stats = StepStats()
    stats.step(sim, steps)
    linear, angular = _momenta(sim)
    L, T = _rigid_rotor(omega, h, steps, integrator == "bdf2")
    # criterion: the loss, of which the box's own stretch, rho (omega L)^2 / E, is a part
    lost = abs((start - angular[2]) - start * (1.0 - L)) / (start * (1.0 - L))
    e = {name: float(value[0]) for name, value in sim.energies().items()}
    energy = abs(e["kinetic"] / kinetic - T) / (1.0 - T)
    small = 1e-3 if setting.single else 1e-8
    limits = {
        "ledger": (abs(e["ledger_residual"]) / kinetic, small),
        "momentum": (float(np.linalg.norm(linear)) / (start / 0.1), small),
        "tilt": (float(np.linalg.norm(angular[:2])) / start, small),
    }
    bound = 0.05 if setting.single else 1e-3
    return Answer(max(lost, energy), bound, "the scheme for a rigid rotor", **stats.answer_fields, limits=limits,
                  drift=e["kinetic"] / kinetic - 1.0, note=f"keeps {L:.4f} of L, {T:.4f} of T")  # fmt: skip


def _rigid_rotor(omega: float, h: float, steps: int, second: bool) -> tuple[float, float]:
    """Angular momentum and energy of a point on the unit circle after steps of the scheme, over the initial ones."""
    x, v = [np.array([1.0, 0.0])], [np.array([0.0, omega])]
    for n in range(steps):
        beta, x_free, v_free = 1.0, x[-1], v[-1]
        if second and n:
            beta = 2.0 / 3.0
            x_free, v_free = ((4.0 * q[-1] - q[-2]) / 3.0 for q in (x, v))
        place = x_free + beta * h * v_free
        x.append(place / np.linalg.norm(place))
        v.append((x[-1] - x_free) / (beta * h))
    (a, b), (c, d) = x[-1], v[-1]
    return float(a * d - b * c) / omega, float(v[-1] @ v[-1]) / omega**2


INTEGRATORS = (
    "backward_euler", "bdf2", "generalized_alpha", "generalized_alpha(rho_inf=0)", "energy_momentum",
    "energy_momentum(rho_inf=0.8)",
)  # fmt: skip
GAIN_REFUSAL = ("energy gain",)
"""Error texts for a scheme that adds energy."""
MAX_ENERGY_GROWTH = 0.1
"""Relative energy gain of a rotating body above which the scheme must be refused."""
ANGULAR_VELOCITY = np.array([1.0, 2.0, 10.0])
"""Angular velocity, rad/s."""


def _rotating_body(setting: Setting, body: str, E: float) -> wf.Model:
    """A T10 bar of 0.5 x 0.2 x 0.1 m that is free, or a 3243 arm of 0.5 m on a hinge, at |ANGULAR_VELOCITY|."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    law = wf.SVK(E=E, nu=0.3, density=1000.0)
    if body == "free":
        solid = b.add_solid(wf.mesh.box((0.5, 0.2, 0.1), cells=(2, 1, 1), element="T10"), material=law)
        b.set_initial(solid, velocity=lambda X: np.cross(ANGULAR_VELOCITY, X - (0.25, 0.1, 0.05)))
        return finalize(b, setting)
    ends = [(0.0, 0.0, 0.0), (0.5, 0.0, 0.0)]
    arm = b.add_beam(ends, elements=2, section=wf.Rectangle(0.05, 0.05), normal=(0, 0, 1), material=law)
    b.add_joint("revolute", parent=wf.GROUND, child=arm.start, axis=(0, 0, 1))
    b.set_initial(arm, angular_velocity=(0.0, 0.0, float(np.linalg.norm(ANGULAR_VELOCITY))))
    return finalize(b, setting)


def _energy_growth(setting: Setting, body: str, scheme: str, turn: float, E: float, steps: int) -> Answer:
    """Largest energy growth over steps of `turn` radians; energy_momentum has its own tighter bounds."""
    model = _rotating_body(setting, body, E)
    sim = wf.Simulation(model, dt=turn / float(np.linalg.norm(ANGULAR_VELOCITY)), integrator=scheme)

    def energy() -> float:
        e = sim.energies()
        return float(e["kinetic"][0] + e["strain"][0])

    first, (p, L), stats, most = energy(), _momenta(sim), StepStats(), 0.0
    for _ in range(steps):
        stats.step(sim)
        most = max(most, energy() / first - 1.0)
    limits = {}
    bound = MAX_ENERGY_GROWTH
    if scheme.startswith("energy_momentum"):
        bound = 1e-2 if setting.single else 1e-6
        if body == "free" and not setting.single:
            now = _momenta(sim)
            size = float(np.linalg.norm(L))
            limits = {
                "momentum": (float(np.linalg.norm(now[0] - p)) / size, 1e-10),
                "angular momentum": (float(np.linalg.norm(now[1] - L)) / size, 1e-6),
            }
    return Answer(most, bound, "its energy at the start", **stats.answer_fields, limits=limits,
                  drift=energy() / first - 1.0, note=f"keeps {energy() / first:.6f} of its energy")  # fmt: skip


@case("turning", "Rotation", quick="float64", refusal=GAIN_REFUSAL, values=(
    ("generalized_alpha", 0.2, 1e9), ("energy_momentum", 0.2, 1e9), ("energy_momentum(rho_inf=0.8)", 0.2, 1e7),
    ("energy_momentum(rho_inf=0.8)", 0.2, 1e9)))  # fmt: skip
def rotating_bar(setting: Setting, value: tuple[str, float, float]) -> Answer:
    """A free bar spins 300 steps of `turn` radians with E in Pa: energy does not grow, or the scheme is refused."""
    return _energy_growth(setting, "free", *value, steps=300)


@case("turning-all", "Rotation", refusal=GAIN_REFUSAL, dtypes=("float64",), values=[
    (body, scheme, turn, E) for body in ("free", "rotor") for scheme in INTEGRATORS for turn in (0.1, 0.3, 0.6)
    for E in (1e7, 1e9, 2e11)])  # fmt: skip
def all_integrators(setting: Setting, value: tuple[str, str, float, float]) -> Answer:
    """A free bar and a rotor on a joint, 100 steps with each scheme: energy does not grow, or the scheme is refused."""
    return _energy_growth(setting, *value, steps=100)
