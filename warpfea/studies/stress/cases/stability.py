"""Snap-through and lateral buckling."""

from typing import Any

import numpy as np
from scipy.optimize import brentq

import warpfea as wf

from ..build import StepStats, Y, add_along_x, finalize, solve
from ..case import Answer, Setting, case

SPAN, RISE, SIDE, E = 1.0, 0.1, 0.1, 1e7
"""Half span, rise and side of the bars of the two-bar truss, m; modulus, Pa."""
BAR_LENGTH = float(np.hypot(SPAN, RISE))


def _apex_load(height: float) -> float:
    """Downward load, N, in equilibrium with the apex at a height; SVK bars without Poisson's effect."""
    strain = (height**2 - RISE**2) / (2.0 * BAR_LENGTH**2)
    return -2.0 * E * SIDE**2 * strain * height / BAR_LENGTH


def _truss(setting: Setting, element: str, load: float) -> wf.Model:
    """Two bars hinged to the ground and to each other, with a dead load on the apex and the probe "apex"."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    law = wf.SVK(E=E, nu=0.0, density=1000.0, damping=wf.KelvinVoigt(eta=1e5))
    ends: list[Any] = []
    for sign in (-1.0, 1.0):
        foot, apex = np.array([sign * SPAN, 0.0, 0.0]), np.array([0.0, 0.0, RISE])
        along = (apex - foot) / BAR_LENGTH
        across = np.cross(along, Y)
        if element == "3243":
            bar = b.add_beam([foot, apex], elements=1, section=wf.Rectangle(SIDE, SIDE), normal=across, material=law)
            foot_end: Any = bar.start
            ends.append(bar.end)
        else:
            mesh = wf.mesh.box((BAR_LENGTH, SIDE, SIDE), cells=(1, 1, 1), origin=(0.0, -SIDE / 2, -SIDE / 2))
            bar = b.add_solid(mesh, material=law, transform=(np.stack([along, Y, across], axis=1), foot))
            foot_end = bar.surface("x-")
            ends.append(bar.surface("x+"))
        b.add_joint("revolute", parent=wf.GROUND, child=foot_end, axis=Y)
    b.add_joint("revolute", parent=ends[0], child=ends[1], axis=Y)
    b.add_probe("apex", ends[0])
    for end in ends:
        down = (0.0, 0.0, -load / 2.0)
        if element == "3243":
            b.add_point_load(end, down)
        else:
            b.add_traction(end, tuple(np.array(down) / SIDE**2))
    return finalize(b, setting)


@case("snap-through", "Stability", values=("3243-dynamic", "T10-dynamic", "3243-static", "T10-static"), quick="both",
      refusal=("was not accepted",))  # fmt: skip
def snap_through(setting: Setting, value: str) -> Answer:
    """A shallow truss of two bars under 1.2 times its snap load comes to rest hanging, at the closed-form position.

    Statics under the load may refuse, or find the same state.
    """
    element, way = value.split("-")
    load = 1.2 * _apex_load(RISE / np.sqrt(3.0))
    height = brentq(lambda z: _apex_load(z) - load, -2.0 * RISE, -RISE, xtol=1e-15)
    model = _truss(setting, element, load)
    stats = StepStats()
    if way == "static":
        probe: Any = wf.solve_static(model, load_steps=6, outputs=[stats]).probe("apex")
    else:
        sim = wf.Simulation(model, dt=2e-2)
        stats.step(sim, 500)
        probe = sim.probe("apex")
    got = probe.position[0, -1, 2]
    return Answer(abs(got / height - 1.0), 1e-3 if setting.single else 1e-6, "closed form", **stats.answer_fields,
                  note=f"apex from {RISE:g} to {got:.5f} m")  # fmt: skip


@case("lateral-buckling", "Stability", values=("0.97", "1.03"), quick="float64", refusal={"float32": ("float32",)})
def lateral_buckling(setting: Setting, value: str) -> Answer:
    """A strip on edge, 1 x 0.04 x 0.004 m, under 0.97 and 1.03 of its lateral buckling load.

    4.013 sqrt(E I G J) / L^2, plus 1.3 % for bending before buckling. With a transverse load of 1e-4 of it the end
    must move less than 0.01 L below, more than 0.1 L above.
    """
    L, t, h, modulus, nu = 1.0, 0.004, 0.04, 1e9, 0.3
    EI, EI_strong = modulus * h * t**3 / 12.0, modulus * t * h**3 / 12.0
    GJ = modulus / (2.0 + 2.0 * nu) * h * t**3 / 3.0 * (1.0 - 0.63 * t / h)
    critical = 4.013 * np.sqrt(EI * GJ) / L**2 / np.sqrt((1.0 - EI / EI_strong) * (1.0 - GJ / EI_strong))
    load = float(value) * critical
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    _, start, end = add_along_x(b, "3243", (16,), (L, t, h), wf.SVK(E=modulus, nu=nu))
    b.clamp(start, slots="position+section")
    b.add_point_load(end, (0.0, 1e-4 * load, -load))
    b.add_probe("tip", end)
    found = solve(b, setting, load_steps=8)
    side = abs(float(found.tip[1])) / L
    error = side / 0.01 if float(value) < 1.0 else 0.1 / side
    note = f"{side:.4f} L to the side; error: over 0.01 L below, 0.1 L over it above"
    return Answer(error, 1.0, "Timoshenko", **found.stats.answer_fields, note=note)
