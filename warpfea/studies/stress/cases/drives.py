"""Discontinuous drives, beams twisted past their critical torque."""

import numpy as np

import warpfea as wf

from ..build import STEEL, beam, relative_error, solve, step
from ..case import FLOAT32_REFUSAL, Answer, Setting, case

REFUSAL_TEXTS = ["'crank'", "drive", "inverted"]
JUMP_STEP = 1e-3
"""Step size, s."""
DRIVE_INTERVALS = {"ramp": (2.0, 3.0), "jump": (2.5, 2.500001)}
"""Begin and end of the drive's rotation, in steps: over a whole one, resolved by halving, or at once."""
SIDE, ELEMENTS = 0.01, 32
"""Side of the twisted beam of 1 m, m."""
LAW = wf.SVK(E=1e9, nu=0.3, density=1000.0)
EI = LAW.E * SIDE**4 / 12.0
GJ = LAW.lame[1] * wf.Rectangle(SIDE, SIDE).torsion_ratio * wf.Rectangle(SIDE, SIDE).polar
GREENHILL_TORQUE = 8.98682
"""Critical torque of a beam with both ends clamped, times L / (E I): the first root of 2 (1 - cos m) = m sin m.

The rotated end is free along the axis: fixed ends would give a tension of E I_p (theta / L)^2 / 2, which prevents
buckling.
"""


@case(
    "drive-jump", "drives", quick="float64", refusal=REFUSAL_TEXTS,
    values=tuple((body, angle, how) for body in ("beam", "solid") for angle in (0.5, 4.0) for how in DRIVE_INTERVALS),
)  # fmt: skip
def drive_jump(setting: Setting, value: tuple[str, float, str]) -> Answer:
    """The drive of a joint rotates by 0.5 or 4 rad in a step, evenly or at once: solved, or refused by name."""
    kind, angle, how = value
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    law = wf.SVK(E=2e7, nu=0.3, density=1100.0)
    if kind == "beam":
        line, section = [(0, 0, 0), (0.3, 0, 0)], wf.Rectangle(0.02, 0.02)
        arm = b.add_beam(line, elements=4, section=section, normal=(0, 0, 1), material=law, name="arm")
    else:
        mesh = wf.mesh.box((0.3, 0.02, 0.02), cells=(6, 1, 1), origin=(0, -0.01, -0.01))
        arm = b.add_solid(mesh, material=law, name="arm")
    begin, end = (JUMP_STEP * at for at in DRIVE_INTERVALS[how])
    jump = ([0.0, begin, end, 1.0], [0.0, 0.0, angle, angle])
    child = arm.start if kind == "beam" else arm.surface("x-")
    joint = b.add_joint("revolute", parent=wf.GROUND, child=child, axis=(0, -1, 0), drive=jump, name="crank")
    sim, stats = step(b, setting, 6, dt=JUMP_STEP)
    error = abs(float(sim.joint_value(joint)[0]) / angle - 1.0)
    reference = "the angle of the drive"
    return stats.answer(error, 1e-3 if setting.single else 1e-6, reference, note=f"min J {stats.min_J:.3g}")


def solve_twisted_beam(setting: Setting, torque_ratio: float) -> Answer:
    """A beam with both ends clamped, one rotated to `torque_ratio` of the critical torque; any stable state is right.

    Force balance and stability are evaluated with the same model in float64.
    """
    critical = GREENHILL_TORQUE * EI / GJ  # rad, for the torque G J theta / L
    b, body = beam(ELEMENTS, SIDE, LAW)
    turn = wf.Rotation(anchor=(1, 0, 0), axis=(1, 0, 0), angle=([0, 1], [0, torque_ratio * critical]))
    b.drive(body.end, rotation=turn, slots="section")
    b.clamp(body.end, slots="position", components="yz")
    found = solve(b, setting, load_steps=20)
    displacement = found.result.state.displacement.numpy().astype(float)
    model = b.finalize(device=setting.device)
    state = model.state()
    state.displacement.assign(displacement)
    free = np.flatnonzero(model.free_slots.ravel())
    force = model.internal_force(state)[0].ravel()
    error = float(np.abs(force[free]).max() / np.abs(force).max())
    K = model.tangent_matrix(state)[free][:, free].toarray().astype(float)
    values = np.linalg.eigvalsh(0.5 * (K + K.T))
    low = float(values[0] / values[-1])
    energy, straight = float(model.strain_energy(state)[0]), 0.5 * GJ * (torque_ratio * critical) ** 2
    across = float(np.abs(found.result.displacements(body)[0, :, 1:]).max())  # m
    limits = {"unstable and not told": (-low, 1e-12)}
    if torque_ratio < 1.0:
        limits["energy off Saint-Venant's"] = (abs(energy / straight - 1.0), 0.02)
        limits["off the axis, m"] = (across, 1e-2 * SIDE if setting.single else 1e-6)
    note = f"lowest eigenvalue {low:.2g} of the largest, {across:.2g} m off the axis, energy {energy / straight:.4f}"
    return found.stats.answer(error, 1e-3 if setting.single else 1e-6, "equilibrium, stable by the tangent matrix",
                              limits=limits, note=note)  # fmt: skip


case("twist-below", "drives", values=(0.5, 0.9), quick="float64", description="A slender beam twisted to a fraction of "
     "Greenhill's critical torque stays straight.")(solve_twisted_beam)  # fmt: skip
case("greenhill", "drives", values=(1.1, 1.5), quick="float64", description="A slender beam past the critical torque: "
     "refused as unstable, reported as such, or on a stable branch.",
     refusal={"float64": ["unstable"], "float32": ["unstable", "float32"]})(solve_twisted_beam)  # fmt: skip


@case("steel-km", "limits", values=(2, 4), quick="float64", refusal=FLOAT32_REFUSAL)
def kilometre_cube(setting: Setting, cells: int) -> Answer:
    """A steel cube of 1 km under its weight, block Jacobi."""

    def cube() -> wf.ModelBuilder:
        b = wf.ModelBuilder(gravity=(0, 0, -9.81))
        body = b.add_solid(wf.mesh.box((1e3,) * 3, cells=(cells,) * 3), material=STEEL, name="cube")
        b.clamp(body.nodes("z-"))
        b.add_probe("tip", body.surface("z+"))
        return b

    reference = solve(cube(), Setting(setting.device, "float64"), load_steps=1, tol=1e-10).tip
    found = solve(cube(), setting, load_steps=1, solver=wf.NewtonPCG(preconditioner="block-jacobi", max_halvings=2))
    bound = 1e-2 if setting.single else 3e-4
    error, stats = relative_error(found.tip, reference), found.stats
    return stats.answer(error, bound, "float64, tol 1e-10", reported_error=stats.last_floor)


@case("work", "limits", quick="float64", refusal=["max_work"], must_refuse=True)
def work_limit(setting: Setting) -> Answer:
    """A plate of slivers under its weight with a small work limit: refused once it is spent."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    mesh = wf.mesh.box((1.0, 1.0, 1e-3), cells=(12, 12, 1), element="T4")
    body = b.add_solid(mesh, material=STEEL, name="slivers")
    b.clamp(body.nodes("x-"))
    solver = wf.NewtonPCG(preconditioner="block-jacobi", max_pcg=20000, max_work=100)
    found = solve(b, setting, load_steps=1, solver=solver)
    return found.stats.answer(0.0, 0.0, "100 products are too few", note=f"{found.stats.pcg} PCG iterations")
