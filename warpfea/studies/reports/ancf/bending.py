"""Statics of beams and shells: cantilevers, a beam rolled into a circle, slender bodies."""

from __future__ import annotations

from typing import Any

import numpy as np

import warpfea as wf

from ...checkout import reference
from ..parts import Rows
from .cases import cantilever, keep_plane, static

__all__ = ["princeton", "rollup", "slender", "static_beam", "static_shell"]


def static_beam(device: Any, quick: bool) -> Rows:
    """Cantilever 1 x 0.1 x 0.1 m, F L^2 / E I = 1, all 12 slots of the root held, beside Project Chrono's rows."""
    chrono = reference("chrono_3243_3443")["static_beam"]["results"]
    names = {"split": "3243_enhanced_3x2x2(default)", "full": "3243_full_5x3x3"}
    rows = []
    for integration in ("tied", "split", "full"):
        for nu in (0.0, 0.3):
            for n in (4, 16) if quick else (1, 2, 4, 8, 16, 32):
                b, beam = cantilever(n, wf.Rectangle(0.1, 0.1), wf.SVK(E=2.07e8, nu=nu), integration)
                b.add_point_load(beam.end, (0, 0, -1725.0))
                result, seconds = static(b, device, load_steps=4, tol=1e-9)
                tip = result.probe("tip").position[0, -1]
                same = [
                    r["tip"] for r in chrono
                    if (r["element"], r["N"], r["nu"], r["k_shear"]) == (names.get(integration), n, nu, 1)
                ]  # fmt: skip
                away = float(np.abs(tip - same[0]).max() / 0.3017) if same else None
                rows.append({"integration": integration, "nu": nu, "elements": n, "tip_x": tip[0], "tip_z": tip[2],
                             "from_chrono": away, "seconds": seconds})  # fmt: skip
    return rows


def static_shell(device: Any, quick: bool) -> Rows:
    """The same cantilever as one row of shells, 0.1 m thick."""
    rows = []
    for integration in ("tied", "full"):
        for nu in (0.0, 0.3):
            for n in (4, 16) if quick else (2, 4, 8, 16, 32):
                b = wf.ModelBuilder(gravity=(0, 0, 0))
                plate = b.add_shell(wf.mesh.grid((1.0, 0.1), cells=(n, 1)), thickness=0.1, integration=integration,
                                    material=wf.SVK(E=2.07e8, nu=nu))  # fmt: skip
                b.clamp(plate.edge("x-"))
                b.add_point_load(plate.edge("x+"), (0, 0, -1725.0))
                b.add_probe("tip", plate.edge("x+"))
                result, seconds = static(b, device, load_steps=4, tol=1e-8)
                tip = result.probe("tip").position[0, -1]
                rows.append({"integration": integration, "nu": nu, "elements": n, "tip_x": tip[0], "tip_z": tip[2],
                             "seconds": seconds})  # fmt: skip
    return rows


def rollup(device: Any, quick: bool) -> Rows:
    """Beam rolled into a circle by an end moment 2 pi E I / L, in a plane, against the limit of its kinematics."""
    table = reference("S4_analytic_beams_plates")["rollup"]["ancf3243_SVK_exact_uniform_bending"]["table"]
    rows = []
    for h, counts in ((0.02, (16,) if quick else (8, 16, 32, 64, 96)), (0.005, () if quick else (16, 32))):
        limit = [r["tip_xy"] for r in table if (r["h_over_L"], r["nu"], r["M_fraction"]) == (h, 0.0, 1.0)]
        for integration in ("tied", "split"):
            for n in counts:
                b, beam = cantilever(n, wf.Rectangle(h, h), wf.SVK(E=1e7, nu=0.0), integration)
                keep_plane(b, beam, "y")
                b.add_moment(beam.end, (0.0, -2.0 * np.pi * 1e7 * h**4 / 12.0, 0.0))
                result, seconds = static(b, device, load_steps=8, tol=1e-7)
                tip = result.probe("tip").position[0, -1]
                error = float(np.hypot(tip[0] - limit[0][0], tip[2] - limit[0][1])) if limit else None
                rows.append({"h": h, "integration": integration, "elements": n, "tip_x": tip[0], "tip_z": tip[2],
                             "closes_to": float(np.hypot(tip[0], tip[2])), "from_limit": error,
                             "seconds": seconds})  # fmt: skip
    return rows


def princeton(device: Any, quick: bool) -> Rows:
    """The Princeton beam against the exact geometrically exact beam, shear factor 5/6."""
    data = reference("S4_princeton_beam")
    L, h, t = data["L"], data["h"], data["t"]
    rows = []
    cases = [r for r in data["results"] if r["ks"] < 0.9 and (not quick or (r["P"] > 13.0 and r["theta_deg"] == 45))]
    for integration in ("tied",) if quick else ("tied", "split"):
        for r in cases:
            law = wf.SVK(E=data["E"], nu=data["nu"])
            b, beam = cantilever(16, wf.Rectangle(h, t), law, integration, L, "position+section")
            theta = np.radians(r["theta_deg"])
            b.add_point_load(beam.end, (0.0, -r["P"] * np.cos(theta), -r["P"] * np.sin(theta)))
            result, seconds = static(b, device, load_steps=4, tol=1e-7)
            F = result.simulation.node_gradients(beam)[0, -1]
            error = np.abs(result.probe("tip").displacement[0, -1] - r["u"]).max() / L
            rows.append({"integration": integration, "P": r["P"], "theta_deg": r["theta_deg"],
                         "tip_error_over_L": float(error), "twist": float(np.arctan2(F[2, 1], F[1, 1])),
                         "twist_reference": r["twist_rad"], "seconds": seconds})  # fmt: skip
    return rows


def slender(device: Any, quick: bool) -> Rows:
    """L/H = 1000 beam (tip load, small and large) and L/t = 1000 plate (clamped, pressure): deflection over theory."""
    elastica = {r["PL2_over_EI"]: r for r in reference("S4_analytic_beams_plates")["elastica_tip_load"]["table"]}
    rows = []
    h, E = 1e-3, 1e9
    for integration in ("tied", "split"):
        for load_factor in (0.2, 1.0):
            b, beam = cantilever(16, wf.Rectangle(h, h), wf.SVK(E=E, nu=0.3), integration)
            b.add_point_load(beam.end, (0, 0, -load_factor * E * h**4 / 12.0))
            result, seconds = static(b, device, load_steps=4, tol=1e-6)
            w = -result.probe("tip").displacement[0, -1, 2]
            rows.append({"case": "beam", "integration": integration, "load": load_factor, "elements": 16,
                         "ratio": float(w / elastica[load_factor]["tip_w_over_L"]), "seconds": seconds})  # fmt: skip
    t, nu = 1e-3, 0.3
    D = E * t**3 / 12.0 / (1.0 - nu**2)
    q = 1e-2 * t * D / 1.26532e-3  # deflects by a hundredth of its thickness
    for integration in ("tied", "full"):
        for n in (8,) if quick else (4, 8, 16):
            b = wf.ModelBuilder(gravity=(0, 0, 0))
            plate = b.add_shell(wf.mesh.grid((1.0, 1.0), cells=(n, n)), thickness=t, material=wf.SVK(E=E, nu=nu),
                                integration=integration)  # fmt: skip
            for side in ("x-", "x+", "y-", "y+"):
                b.clamp(plate.edge(side), slots="position+director")
            b.add_traction(plate.surface("top"), (0, 0, -q))
            b.add_probe("middle", plate.at((0.5, 0.5, 0.0)))
            result, seconds = static(b, device, load_steps=1, tol=1e-6)
            w = -result.probe("middle").displacement[0, -1, 2]
            rows.append({"case": "plate", "integration": integration, "elements": n,
                         "ratio": float(w / (1e-2 * t)), "seconds": seconds})  # fmt: skip
    return rows
