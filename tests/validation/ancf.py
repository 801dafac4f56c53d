"""ANCF elements against references independent of warpfea, for every integration.

The references are copies under tests/data (with their `source`). Every row names the integration;
"tied" is the default.
"""

# mypy: disable-error-code="index"
# (vectors of device functions: Warp does not declare that they can be indexed)

from __future__ import annotations

import time as clock
from collections.abc import Iterator
from typing import Any

import numpy as np
import scipy.sparse.linalg as linalg
import warp as wp

import warpfea as wf
from warpfea.model.assembly import shape_and_jacobian
from warpfea.simulation.statics import StaticResult
from warpfea.studies.files import reference_data

from .table import Row, Run, Table

__all__ = ["TABLE", "frequencies", "princeton", "static_beam"]

X, Z = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)


def cantilever(
    elements: int, section: wf.Rectangle, law: wf.SVK, integration: str, length: float = 1.0, slots: str = "all"
) -> tuple[wf.ModelBuilder, wf.Body]:
    """A beam along x without gravity, `slots` of its root clamped, with the probe "tip"; `length` in m."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    beam = b.add_beam([(0, 0, 0), (length, 0, 0)], elements=elements, section=section, normal=Z, material=law,
                      integration=integration)  # fmt: skip
    b.clamp(beam.start, slots=slots)
    b.add_probe("tip", beam.end)
    return b, beam


def keep_plane(b: wf.ModelBuilder, beam: wf.Body, component: str) -> None:
    """Solve in a plane: all slots of the component clamped."""
    b.clamp(beam.nodes(lambda X: X[:, 0] > -1.0), components=component)


def static(b: wf.ModelBuilder, device: Any, **options: Any) -> tuple[StaticResult, float]:
    """Static result and its wall time in seconds, compilation included."""
    model = b.finalize(device=device)
    began = clock.perf_counter()
    result = wf.solve_static(model, **options)
    return result, clock.perf_counter() - began


def static_beam(run: Run) -> Iterator[Row]:
    """Cantilever 1 x 0.1 x 0.1 m, F L^2 / E I = 1, all 12 slots of the root clamped, beside Project Chrono's rows."""
    chrono = reference_data("chrono_3243_3443")["static_beam"]["results"]
    names = {"split": "3243_enhanced_3x2x2(default)", "full": "3243_full_5x3x3"}
    for integration in ("tied", "split", "full"):
        for nu in (0.0, 0.3):
            for n in (4, 16) if run.quick else (1, 2, 4, 8, 16, 32):
                b, beam = cantilever(n, wf.Rectangle(0.1, 0.1), wf.SVK(E=2.07e8, nu=nu), integration)
                b.add_point_load(beam.end, (0, 0, -1725.0))
                result, seconds = static(b, run.device, load_steps=4, tol=1e-9)
                tip = result.probe("tip").position[0, -1]
                same = [
                    r["tip"] for r in chrono
                    if (r["element"], r["N"], r["nu"], r["k_shear"]) == (names.get(integration), n, nu, 1)
                ]  # fmt: skip
                away = float(np.abs(tip - same[0]).max() / 0.3017) if same else None
                yield {"integration": integration, "nu": nu, "elements": n, "tip_x": tip[0], "tip_z": tip[2],
                       "from_chrono": away, "seconds": seconds}  # fmt: skip


def static_shell(run: Run) -> Iterator[Row]:
    """The same cantilever as one row of shells, 0.1 m thick."""
    for integration in ("tied", "full"):
        for nu in (0.0, 0.3):
            for n in (4, 16) if run.quick else (2, 4, 8, 16, 32):
                b = wf.ModelBuilder(gravity=(0, 0, 0))
                plate = b.add_shell(wf.mesh.grid((1.0, 0.1), cells=(n, 1)), thickness=0.1, integration=integration,
                                    material=wf.SVK(E=2.07e8, nu=nu))  # fmt: skip
                b.clamp(plate.edge("x-"))
                b.add_point_load(plate.edge("x+"), (0, 0, -1725.0))
                b.add_probe("tip", plate.edge("x+"))
                result, seconds = static(b, run.device, load_steps=4, tol=1e-8)
                tip = result.probe("tip").position[0, -1]
                yield {"integration": integration, "nu": nu, "elements": n, "tip_x": tip[0], "tip_z": tip[2],
                       "seconds": seconds}  # fmt: skip


def rollup(run: Run) -> Iterator[Row]:
    """Beam rolled into a circle by an end moment 2 pi E I / L, in a plane, against the limit of its kinematics."""
    table = reference_data("S4_analytic_beams_plates")["rollup"]["ancf3243_SVK_exact_uniform_bending"]["table"]
    for h, counts in ((0.02, (16,) if run.quick else (8, 16, 32, 64, 96)), (0.005, () if run.quick else (16, 32))):
        limit = [r["tip_xy"] for r in table if (r["h_over_L"], r["nu"], r["M_fraction"]) == (h, 0.0, 1.0)]
        for integration in ("tied", "split"):
            for n in counts:
                b, beam = cantilever(n, wf.Rectangle(h, h), wf.SVK(E=1e7, nu=0.0), integration)
                keep_plane(b, beam, "y")
                b.add_moment(beam.end, (0.0, -2.0 * np.pi * 1e7 * h**4 / 12.0, 0.0))
                result, seconds = static(b, run.device, load_steps=8, tol=1e-7)
                tip = result.probe("tip").position[0, -1]
                error = float(np.hypot(tip[0] - limit[0][0], tip[2] - limit[0][1])) if limit else None
                yield {"h": h, "integration": integration, "elements": n, "tip_x": tip[0], "tip_z": tip[2],
                       "closes_to": float(np.hypot(tip[0], tip[2])), "from_limit": error,
                       "seconds": seconds}  # fmt: skip


def princeton(run: Run) -> Iterator[Row]:
    """The Princeton beam against the exact geometrically exact beam, shear factor 5/6."""
    data = reference_data("S4_princeton_beam")
    L, h, t = data["L"], data["h"], data["t"]
    cases = [
        r for r in data["results"] if r["ks"] < 0.9 and (not run.quick or (r["P"] > 13.0 and r["theta_deg"] == 45))
    ]
    for integration in ("tied",) if run.quick else ("tied", "split"):
        for r in cases:
            law = wf.SVK(E=data["E"], nu=data["nu"])
            b, beam = cantilever(16, wf.Rectangle(h, t), law, integration, L, "position+section")
            theta = np.radians(r["theta_deg"])
            b.add_point_load(beam.end, (0.0, -r["P"] * np.cos(theta), -r["P"] * np.sin(theta)))
            result, seconds = static(b, run.device, load_steps=4, tol=1e-7)
            F = result.simulation.node_gradients(beam)[0, -1]
            error = np.abs(result.probe("tip").displacement[0, -1] - r["u"]).max() / L
            yield {"integration": integration, "P": r["P"], "theta_deg": r["theta_deg"],
                   "tip_error_over_L": float(error), "twist": float(np.arctan2(F[2, 1], F[1, 1])),
                   "twist_reference": r["twist_rad"], "seconds": seconds}  # fmt: skip


def slender(run: Run) -> Iterator[Row]:
    """L/H = 1000 beam (tip load, small and large) and L/t = 1000 plate (clamped, pressure): deflection over theory."""
    elastica = {r["PL2_over_EI"]: r for r in reference_data("S4_analytic_beams_plates")["elastica_tip_load"]["table"]}
    h, E = 1e-3, 1e9
    for integration in ("tied", "split"):
        for load_factor in (0.2, 1.0):
            b, beam = cantilever(16, wf.Rectangle(h, h), wf.SVK(E=E, nu=0.3), integration)
            b.add_point_load(beam.end, (0, 0, -load_factor * E * h**4 / 12.0))
            result, seconds = static(b, run.device, load_steps=4, tol=1e-6)
            w = -result.probe("tip").displacement[0, -1, 2]
            yield {"case": "beam", "integration": integration, "load": load_factor, "elements": 16,
                   "ratio": float(w / elastica[load_factor]["tip_w_over_L"]), "seconds": seconds}  # fmt: skip
    t, nu = 1e-3, 0.3
    D = E * t**3 / 12.0 / (1.0 - nu**2)
    q = 1e-2 * t * D / 1.26532e-3  # deflects by a hundredth of its thickness
    for integration in ("tied", "full"):
        for n in (8,) if run.quick else (4, 8, 16):
            b = wf.ModelBuilder(gravity=(0, 0, 0))
            plate = b.add_shell(wf.mesh.grid((1.0, 1.0), cells=(n, n)), thickness=t, material=wf.SVK(E=E, nu=nu),
                                integration=integration)  # fmt: skip
            for side in ("x-", "x+", "y-", "y+"):
                b.clamp(plate.edge(side), slots="position+director")
            b.add_traction(plate.surface("top"), (0, 0, -q))
            b.add_probe("middle", plate.at((0.5, 0.5, 0.0)))
            result, seconds = static(b, run.device, load_steps=1, tol=1e-6)
            w = -result.probe("middle").displacement[0, -1, 2]
            yield {"case": "plate", "integration": integration, "elements": n,
                   "ratio": float(w / (1e-2 * t)), "seconds": seconds}  # fmt: skip


def frequencies(run: Run) -> Iterator[Row]:
    """Cantilever beam 1 x 0.05 x 0.05 m and plate 1 x 1 x 0.02 m clamped at one edge, 16 elements along a side."""
    data = reference_data("S4_analytic_beams_plates")
    for nu in (0.0, 0.3):
        for integration in ("tied", "split", "full"):
            law = wf.SVK(E=1e7, nu=nu, density=1000.0)
            b, _ = cantilever(16, wf.Rectangle(0.05, 0.05), law, integration, slots="position+section")
            got = lowest(b, run.device, 14)
            limit = data["beam_frequencies"]["ancf3243_kinematics_3D_continuum"][f"cantilever_nu{nu}"]["omega_first10"]
            beam = data["beam_frequencies"]["timoshenko"][f"cantilever_nu{nu}_ks0.8333"]["omega"]
            yield _modes("3243", integration, nu, got, limit, beam, 5)
        for integration in ("tied", "full"):
            if run.quick:
                continue
            b = wf.ModelBuilder(gravity=(0, 0, 0))
            law = wf.SVK(E=1e9, nu=nu, density=1000.0)
            plate = b.add_shell(wf.mesh.grid((1.0, 1.0), cells=(16, 16)), thickness=0.02, material=law,
                                integration=integration)  # fmt: skip
            b.clamp(plate.edge("x-"), slots="position+director")
            got = lowest(b, run.device, 6)
            limit = data["plate_frequencies"]["ancf3443_kinematics"][f"CFFF_nu{nu}"]["omega"]
            mindlin = data["plate_frequencies"]["mindlin"][f"CFFF_nu{nu}_ks0.8333"]["omega"]
            yield _modes("3443", integration, nu, got, limit, mindlin, 3)


def lowest(b, device, count):
    """Lowest angular frequencies at rest, rad/s, by scipy."""
    model = b.finalize(device=device)
    free = np.flatnonzero(model.free_slots.ravel())
    K, M = (A[free][:, free] for A in (model.tangent_matrix(model.state()), model.mass_matrix()))
    w2 = linalg.eigsh(((K + K.T) / 2).tocsc(), k=count, M=M.tocsc(), sigma=-10.0, which="LM")[0]
    return np.sqrt(np.abs(np.sort(w2)))


def _modes(element, integration, nu, got, limit, theory, count):
    """Errors of the first modes: as sorted against the limit of the kinematics, the bending ones against theory."""
    near = [float(got[np.argmin(np.abs(got - w))]) for w in theory[:count]]
    return {"element": element, "integration": integration, "nu": nu, "omega": [float(w) for w in got[:10]],
            "from_kinematic_limit": [float(abs(a / b - 1.0)) for a, b in zip(got, limit[:count])],
            "from_theory": [float(abs(a / b - 1.0)) for a, b in zip(near, theory)]}  # fmt: skip


def pendulum(run: Run) -> Iterator[Row]:
    """Flexible pendulum for 1 s with BDF2 against the spectral solution of 3243's kinematics (SVK)."""
    cases = reference_data("S4_pendulum_spectral")["cases"]
    for name in ("stiff_E5e7_ANCF3243_SVK_nu0", "soft_E5e6_ANCF3243_SVK_nu0", "stiff_E5e7_ANCF3243_SVK_nu0.3"):
        case = cases[name]
        plain = case["nu"] == 0.0
        for integration in ("tied", "split") if plain else ("full",):
            for n, dt in ((16, 1e-3),) if run.quick else ((4, 5e-4), (8, 5e-4), (16, 1e-3), (16, 5e-4), (32, 5e-4)):
                b = wf.ModelBuilder(gravity=(0, -9.81, 0))
                law = wf.SVK(E=case["E"], nu=case["nu"], density=1000.0)
                beam = b.add_beam([(0, 0, 0), X], elements=n, section=wf.Rectangle(0.02, 0.02), normal=Z, material=law,
                                  integration=integration)  # fmt: skip
                b.clamp(beam.start, slots="position")
                b.add_probe("tip", beam.end)
                model = b.finalize(device=run.device)
                solver = wf.NewtonPCG(tol=1e-7, max_pcg=20000)
                sim = wf.Simulation(model, dt=dt, integrator="bdf2", solver=solver, ledger=False)
                began = clock.perf_counter()
                sim.run(1.0, progress=False)
                seconds = clock.perf_counter() - began
                at = np.round(np.array(case["times"]) / dt).astype(int)[1:] - 1
                tip = sim.probe("tip").position[0, at, :2]
                error = np.linalg.norm(tip - np.array(case["tip"])[1:], axis=1).max()
                yield {"case": name, "integration": integration, "elements": n, "dt": dt, "error": float(error),
                       "seconds": seconds, "pcg": int(sim.totals["pcg"][0])}  # fmt: skip


A = wp.constant(wp.float64(1e-6))
PI = wp.constant(wp.float64(np.pi))
LAW = wf.SVK(E=1.0, nu=0.25, density=1.0)  # lambda = mu = 0.4


@wp.func
def manufactured_force(x: wp.vec3d, t: wp.float64) -> wp.vec3d:
    """-div of the small-strain stress of u = A sin(pi x) sin(pi y) sin(pi z) (1, 1, 1), lambda = mu = 0.4."""
    s = wp.vec3d(wp.sin(PI * x[0]), wp.sin(PI * x[1]), wp.sin(PI * x[2]))
    c = wp.vec3d(wp.cos(PI * x[0]), wp.cos(PI * x[1]), wp.cos(PI * x[2]))
    sss = s[0] * s[1] * s[2]
    xy = c[0] * c[1] * s[2]
    yz = s[0] * c[1] * c[2]
    xz = c[0] * s[1] * c[2]
    k = A * PI * PI * wp.float64(0.4)
    three, two, one = wp.float64(3.0), wp.float64(2.0), wp.float64(1.0)
    grad_div = wp.vec3d(-sss + xy + xz, -sss + xy + yz, -sss + xz + yz)
    return k * (three * wp.vec3d(sss, sss, sss) * one - two * grad_div)


def manufactured(run: Run) -> Iterator[Row]:
    """A manufactured displacement of a clamped cube: error of u in the mean square over its own, and its order in h."""
    sizes = {"T4": (4, 8, 16), "T10": (2, 4, 8), "FN": (2, 4, 8, 16), "FN18": (2, 4, 8, 16), "ENMC": (2, 4, 8, 16),
             "H3843": (2, 4, 8, 12)}  # fmt: skip
    for element, counts in sizes.items():
        last: tuple[int, float] | None = None
        for n in counts[:2] if run.quick else counts:
            b = wf.ModelBuilder(gravity=(0, 0, 0))
            cube = b.add_solid(wf.mesh.box((1, 1, 1), cells=(n, n, n), element=element), element=element, material=LAW)
            for axis in range(3):
                for side in (0.0, 1.0):
                    face = cube.nodes(lambda X, a=axis, s=side: np.abs(X[:, a] - s) < 1e-9)
                    b.clamp(face, slots="position")
                    if element not in ("T4", "T10"):  # the face's own directions: it keeps its position
                        names = [f"gradient-{c}" for k, c in enumerate("xyz") if k != axis]
                        b.clamp(face, slots="+".join(names))
            b.add_body_force(manufactured_force, bodies=[cube])
            result, seconds = static(b, run.device, load_steps=1, tol=1e-9)
            error = _mean_square_error(cube, result.state)
            unknowns = int(result.simulation.model.free_slots.sum())
            order = None if last is None else float(np.log(last[1] / error) / np.log(n / last[0]))
            last = (n, error)
            yield {"element": element, "cells": n, "unknowns": unknowns, "error": error, "order": order,
                   "seconds": seconds}  # fmt: skip


def _mean_square_error(body, state):
    """Error of the displacement in the mean square over the body, over that of the exact one."""
    rule = body.family.curved_mass_rule
    every = np.arange(len(body.mesh.cells))
    s, _, _, det = shape_and_jacobian(body, every, rule.points)
    conn = body.connectivity
    u = state.displacement.numpy()[0, body.slot_offset : body.slot_offset + body.slot_count]  # as connectivity counts
    position = (body.slot_kind[conn] == 0)[:, :, None]
    table = np.broadcast_to(s, (len(every), *s.shape[1:]))
    x = np.einsum("eqs,esk->eqk", table, body.reference[conn] + position * body.origin)
    got = np.einsum("eqs,esk->eqk", table, u[conn])
    exact = 1e-6 * np.prod(np.sin(np.pi * x), axis=2)[:, :, None]
    w = (det * rule.weights)[:, :, None]
    return float(np.sqrt(np.sum(w * (got - exact) ** 2) / (3.0 * np.sum(w * exact**2))))


@wp.func
def sine_in_x(x: wp.vec3d, t: wp.float64) -> wp.vec3d:
    """A load per mass along the beam."""
    return wp.vec3d(wp.float64(0.0), wp.float64(0.0), -A * wp.sin(PI * x[0]))


@wp.func
def sine_in_xy(x: wp.vec3d, t: wp.float64) -> wp.vec3d:
    """A load per mass over the plate."""
    return wp.vec3d(wp.float64(0.0), wp.float64(0.0), -A * wp.sin(PI * x[0]) * wp.sin(PI * x[1]))


def manufactured_structures(run: Run) -> Iterator[Row]:
    """Simply supported beam and plate of size 1, thickness 0.05, bent into sines: mid deflection, closed forms."""
    h, E, nu = 0.05, 1e3, 0.3
    mu = E / 2.0 / (1.0 + nu)
    for integration, k in (("tied", 5.0 / 6.0), ("split", 1.0)):
        exact = 1e-6 * (1.0 / (E * h**2 / 12.0 * np.pi**4) + 1.0 / (k * mu * np.pi**2))  # rho = 1; per area of section
        last = None
        for n in (2, 4, 8, 16):
            b = wf.ModelBuilder(gravity=(0, 0, 0))
            beam = b.add_beam([(0, 0, 0), X], elements=n, section=wf.Rectangle(h, h), normal=Z,
                              material=wf.SVK(E=E, nu=nu, density=1.0), integration=integration)  # fmt: skip
            b.clamp(beam.start, slots="position")
            b.clamp(beam.end, slots="position", components="yz")
            b.clamp(beam.nodes(lambda X: X[:, 0] > -1.0), components="y")
            b.add_body_force(sine_in_x, bodies=[beam])
            b.add_probe("middle", beam.at((0.5, 0.0, 0.0)))
            last = _order_row("3243", integration, n, static(b, run.device, load_steps=1, tol=1e-9), exact, last)
            yield last
    D = E * h**2 / 12.0 / (1.0 - nu**2)
    exact = 1e-6 * (1.0 / (4.0 * np.pi**4 * D) + 1.0 / (2.0 * np.pi**2 * 5.0 / 6.0 * mu))
    last = None
    for n in (2, 4, 8) if run.quick else (2, 4, 8, 16):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        plate = b.add_shell(wf.mesh.grid((1.0, 1.0), cells=(n, n)), thickness=h,
                            material=wf.SVK(E=E, nu=nu, density=1.0))  # fmt: skip
        b.clamp(plate.nodes(lambda X: X[:, 0] > -1.0), slots="position", components="xy")
        for sides, along in ((("x-", "x+"), "y"), (("y-", "y+"), "x")):
            for side in sides:
                b.clamp(plate.edge(side), slots="position", components="z")
                b.clamp(plate.edge(side), slots="director", components=along)
        b.add_body_force(sine_in_xy, bodies=[plate])
        b.add_probe("middle", plate.at((0.5, 0.5, 0.0)))
        last = _order_row("3443", "tied", n, static(b, run.device, load_steps=1, tol=1e-9), exact, last)
        yield last


def _order_row(element, integration, n, solved, exact, last):
    """Error of the deflection of the middle over its exact value, and its order from the row before."""
    result, seconds = solved
    w = -result.probe("middle").displacement[0, -1, 2]
    error = float(abs(w / exact - 1.0))
    order = float(np.log2(last["error"] / error)) if last and last["integration"] == integration else None
    return {"element": element, "integration": integration, "elements": n, "error": error, "order": order,
            "seconds": seconds}  # fmt: skip


PARTS = (
    static_beam,
    static_shell,
    rollup,
    princeton,
    frequencies,
    pendulum,
    slender,
    manufactured,
    manufactured_structures,
)
TABLE = Table(
    about=__doc__,
    parts={part.__name__: part for part in PARTS},
    results={"ancf_reference.json": "ancf --out tests/results/ancf_reference.json"},
    apart=True,
)
