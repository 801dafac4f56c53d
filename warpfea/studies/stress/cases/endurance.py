"""A million steps at rest, one failing world among many, a load that becomes NaN."""

from typing import Any

import numpy as np
import warp as wp

import warpfea as wf

from ..build import StepStats, add_along_x, finalize
from ..case import Answer, Setting, case

LAW = wf.SVK(E=1e6, nu=0.3, density=1000.0)
SOFT_LAW = wf.NeoHookean.from_E_nu(E=1e6, nu=0.3, density=1000.0)


@case("rest-1e6", "Endurance", values=("T4", "3243"))
def long_rest(setting: Setting, element: str) -> Answer:
    """A hanging body at rest keeps its position over 1e6 steps, 1e5 on a GPU, where a small world is slow.

    In float32 the first 1000 steps damp the residual of statics, tolerance 1e-4.
    """
    steps = 100_000 if "cuda" in setting.device else 1_000_000
    b = wf.ModelBuilder()
    size = (1.0, 0.1, 0.1) if element == "3243" else (0.3, 0.3, 0.3)
    _, start, _ = add_along_x(b, element, (1, 1, 1), size, LAW)
    b.clamp(start)
    model = finalize(b, setting)
    stats = StepStats()
    static = wf.solve_static(model, load_steps=1, tol=None if setting.single else 1e-13, outputs=[stats])
    initial = static.state.displacement.numpy().copy()
    sim = wf.Simulation(model, static.state, dt=1e-2, record=False)
    first: dict[str, Any] | None = None
    drift = 0.0
    for _ in range(steps // 1000):
        sim.step(1000)
        stats.add(sim)
        e = sim.energies()
        if setting.single and first is None:
            initial = sim.state.displacement.numpy().copy()
        total = float((e["kinetic"] + e["strain"] + e["potential"])[0])
        first = first or {"total": total, "strain": float(e["strain"][0])}
        drift = max(drift, abs(total - first["total"]) / first["strain"])
    moved = float(np.abs(sim.state.displacement.numpy() - initial).max() / np.abs(initial).max())
    limits = {"energy": (drift, 1e-5 if setting.single else 1e-10)}
    values = stats.answer_fields | {name: int(sim.totals[name].max()) for name in ("newton", "pcg")}
    return Answer(moved, 1e-5 if setting.single else 1e-12, "it stays", **values, limits=limits, drift=drift,
                  note=f"{steps:.0e} steps of 10 ms")  # fmt: skip


@case("one-of-4096", "Endurance", values=("nan", "inside-out"), quick="both")
def one_failing_world(setting: Setting, value: str) -> Answer:
    """One of 4096 worlds (64 on a CPU) fails: it is reported and frozen, and the others are bitwise unchanged."""
    worlds = 4096 if "cuda" in setting.device else 64
    bad, steps = 7, 5
    b = wf.ModelBuilder()
    body = b.add_solid(wf.mesh.box((1, 0.4, 0.4), cells=(2, 1, 1)), material=SOFT_LAW)
    b.clamp(body.nodes("x-"))
    model = finalize(b, setting, worlds=worlds)
    model.set_gravity(np.linspace(1.0, 20.0, worlds)[:, None] * (0.0, 0.0, -1.0))
    stats = StepStats()
    ends = []
    for harm in (False, True):
        state = model.state()
        if harm:
            array = state.velocity if value == "nan" else state.displacement
            values = array.numpy()
            free = model.free_slots.reshape(values.shape[1:])
            wrong = np.nan if value == "nan" else -1.5 * model.slot_table.reference * (1.0, 0.0, 0.0)
            values[bad] = np.where(free, wrong, values[bad])
            array.assign(values)
        before = {k: v[bad].tobytes() for k, v in state.numpy().items()}
        sim = wf.Simulation(model, state, dt=5e-3, on_failure="freeze")
        stats.step(sim, steps)
        ends.append((sim.status, sim.state.numpy(), before))
    others = np.arange(worlds) != bad
    (_, sound, _), (status, harmed, before) = ends
    same = all((sound[k][others].tobytes() == harmed[k][others].tobytes()) for k in ("displacement", "velocity"))
    kept = all(harmed[k][bad].tobytes() == before[k] for k in ("displacement", "velocity", "time"))
    reported = status[bad] == 1 and not status[others].any()
    error = float(not same) + float(not reported) + float(not kept)
    return Answer(error, 0.0, "a run without the failure, bit for bit", **stats.answer_fields, note=f"{worlds} worlds")


@wp.func
def _nan_body_force(x: wp.vec3d, t: wp.float64) -> wp.vec3d:
    """N/kg; NaN after 25 ms."""
    return wp.vec3d(wp.float64(0.0), wp.float64(0.0), -wp.sqrt(wp.float64(0.025) - t))


@wp.func
def _nan_force_law(t: wp.float64) -> wp.vec3d:
    """N; NaN after 25 ms."""
    return wp.vec3d(wp.float64(0.0), wp.float64(0.0), -wp.sqrt(wp.float64(0.025) - t))


@case(
    "nan-load", "Endurance", values=("field", "law"), quick="both", must_refuse=True, refusal=("step from t = 0.02 s",)
)
def nan_load(setting: Setting, value: str) -> Answer:
    """A load that is NaN from 25 ms on is refused then, with the time, and the state is that before the step."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1)), material=LAW)
    b.clamp(body.nodes("x-"))
    if value == "field":
        b.add_body_force(_nan_body_force)
    else:
        b.add_point_load(body.nodes("x+"), _nan_force_law)
    sim = wf.Simulation(finalize(b, setting), dt=1e-2)
    stats = StepStats()
    wrong = Answer(float("nan"), 0.0, "a refusal that leaves the state", **stats.answer_fields)
    before: dict[str, bytes] = {}
    try:
        for _ in range(5):
            before = {k: v.tobytes() for k, v in sim.state.numpy().items()}
            stats.step(sim)
    except wf.ConvergenceError as error:
        after = sim.state.numpy()
        intact = all(v.tobytes() == before[k] for k, v in after.items() if k != "status")
        if not intact or not np.isfinite(after["displacement"]).all() or "finite" not in str(error):
            return wrong
        raise
    return wrong
