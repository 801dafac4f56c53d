"""Frequencies of a cantilever beam and plate, and a pendulum that bends."""

from __future__ import annotations

import time as clock
from typing import Any

import numpy as np
import scipy.sparse.linalg as linalg

import warpfea as wf

from ...checkout import reference
from ..parts import Rows
from .cases import X, Z, cantilever

__all__ = ["frequencies", "pendulum"]


def frequencies(device: Any, quick: bool) -> Rows:
    """Cantilever beam 1 x 0.05 x 0.05 m and plate 1 x 1 x 0.02 m clamped at one edge, 16 elements along a side."""
    data = reference("S4_analytic_beams_plates")
    rows = []
    for nu in (0.0, 0.3):
        for integration in ("tied", "split", "full"):
            law = wf.SVK(E=1e7, nu=nu, density=1000.0)
            b, _ = cantilever(16, wf.Rectangle(0.05, 0.05), law, integration, slots="position+section")
            got = lowest(b, device, 14)
            limit = data["beam_frequencies"]["ancf3243_kinematics_3D_continuum"][f"cantilever_nu{nu}"]["omega_first10"]
            beam = data["beam_frequencies"]["timoshenko"][f"cantilever_nu{nu}_ks0.8333"]["omega"]
            rows.append(_modes("3243", integration, nu, got, limit, beam, 5))
        for integration in ("tied", "full"):
            if quick:
                continue
            b = wf.ModelBuilder(gravity=(0, 0, 0))
            law = wf.SVK(E=1e9, nu=nu, density=1000.0)
            plate = b.add_shell(wf.mesh.grid((1.0, 1.0), cells=(16, 16)), thickness=0.02, material=law,
                                integration=integration)  # fmt: skip
            b.clamp(plate.edge("x-"), slots="position+director")
            got = lowest(b, device, 6)
            limit = data["plate_frequencies"]["ancf3443_kinematics"][f"CFFF_nu{nu}"]["omega"]
            mindlin = data["plate_frequencies"]["mindlin"][f"CFFF_nu{nu}_ks0.8333"]["omega"]
            rows.append(_modes("3443", integration, nu, got, limit, mindlin, 3))
    return rows


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


def pendulum(device: Any, quick: bool) -> Rows:
    """Flexible pendulum for 1 s with BDF2 against the spectral solution of 3243's kinematics (SVK)."""
    cases = reference("S4_pendulum_spectral")["cases"]
    rows = []
    for name in ("stiff_E5e7_ANCF3243_SVK_nu0", "soft_E5e6_ANCF3243_SVK_nu0", "stiff_E5e7_ANCF3243_SVK_nu0.3"):
        case = cases[name]
        plain = case["nu"] == 0.0
        for integration in ("tied", "split") if plain else ("full",):
            for n, dt in ((16, 1e-3),) if quick else ((4, 5e-4), (8, 5e-4), (16, 1e-3), (16, 5e-4), (32, 5e-4)):
                b = wf.ModelBuilder(gravity=(0, -9.81, 0))
                law = wf.SVK(E=case["E"], nu=case["nu"], density=1000.0)
                beam = b.add_beam([(0, 0, 0), X], elements=n, section=wf.Rectangle(0.02, 0.02), normal=Z, material=law,
                                  integration=integration)  # fmt: skip
                b.clamp(beam.start, slots="position")
                b.add_probe("tip", beam.end)
                model = b.finalize(device=device)
                solver = wf.NewtonPCG(tol=1e-7, max_pcg=20000)
                sim = wf.Simulation(model, dt=dt, integrator="bdf2", solver=solver, ledger=False)
                began = clock.perf_counter()
                sim.run(1.0, progress=False)
                seconds = clock.perf_counter() - began
                at = np.round(np.array(case["times"]) / dt).astype(int)[1:] - 1
                tip = sim.probe("tip").position[0, at, :2]
                error = np.linalg.norm(tip - np.array(case["tip"])[1:], axis=1).max()
                rows.append({"case": name, "integration": integration, "elements": n, "dt": dt, "error": float(error),
                             "seconds": seconds, "pcg": int(sim.totals["pcg"][0])})  # fmt: skip
    return rows
