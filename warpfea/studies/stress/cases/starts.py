"""Starts that no motion leads to: inside out, flat, in one point, scrambled."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

import warpfea as wf

from ..case import Answer, Setting, case
from ._common import Effort, Z, finalize, split

MODULUS = 1e6
SOLIDS = ("T4", "T10", "ENMC", "FN18", "H3843")
ROWS = [f"{e}-{law}" for e in SOLIDS for law in ("svk", "neo")] + ["3243-svk", "3443-svk"]

NAMED = ("worst element", "J <= 0")
"""A refusal names the element."""


def _body(b: wf.ModelBuilder, element: str, law: str) -> wf.Body:
    """A body 1 m long along x, held at x = 0."""
    material = (wf.SVK if law == "svk" else wf.NeoHookean).from_E_nu(E=MODULUS, nu=0.3)
    if element == "3243":
        body = b.add_beam([(0, 0, 0), (1, 0, 0)], elements=4, section=wf.Rectangle(0.1, 0.1), normal=Z,
                          material=material)  # fmt: skip
        b.clamp(body.start)
    elif element == "3443":
        body = b.add_shell(wf.mesh.grid((1.0, 0.5), cells=(4, 2)), thickness=0.05, material=material)
        b.clamp(body.edge("x-"))
    else:
        mesh = wf.mesh.box((1.0, 0.4, 0.4), cells=(4, 2, 2), element=element)
        body = b.add_solid(mesh, element=element, material=material)
        b.clamp(body.nodes("x-"))
    return body


def _starts(kind: str, body: wf.Body) -> np.ndarray:
    """Slot values (slots, 3) of a start, positions from the body's middle."""
    E = body.reference
    if kind == "inverted":
        return E * (-1.0, 1.0, 1.0)
    if kind == "flat":
        return E * (1.0, 1.0, 0.0)
    if kind == "collapsed":
        return 0.0 * E
    size = np.where(body.slot_kind == 0, 0.05, 0.3)[:, None]
    if body.materials[0][1].law != "svk":  # no point inside out
        size = 0.2 * size
    return E + size * np.random.default_rng(0).standard_normal(E.shape)


def _run(setting: Setting, value: str, kind: str) -> Answer:
    """Solve a start without load; how far the end is from rest, over the length."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = _body(b, *split(value))
    model = finalize(b, setting)
    state = model.state()
    u = (_starts(kind, body) - body.reference) * model.free_slots[body.slots]
    state.displacement.assign(u[None].astype(state.displacement.numpy().dtype))
    effort = Effort()
    bound = 1e-4 if setting.single else 1e-6
    # rest is stress-free: its forces have no scale but rounding in those of a strain of 1
    area = {"3243": 0.01, "3443": 0.025}.get(body.family.name, 0.16)
    solver = wf.NewtonPCG(max_newton=200, max_pcg=20000, force_tol=(2e-7 if setting.single else 1e-12) * MODULUS * area)
    result = wf.solve_static(model, load_steps=1, state=state, solver=solver, outputs=[effort])
    low = float(result.report.min_J[0])
    away = float(np.abs(result.displacements(body)).max())
    told = effort.told | {"min_J": low}
    if low <= 0.0:
        return Answer(0.0, bound, "min_J <= 0 is reported", **told, note=f"stays so, {away:.2g} m off; reported")
    return Answer(away, bound, "rest", **told, note="recovered" if away <= bound else "another equilibrium")


def _add(kind: str, about: str) -> Callable[..., Answer]:
    def run(setting: Setting, value: str) -> Answer:
        return _run(setting, value, kind)

    run.__doc__ = about
    refusal = {"float64": NAMED, "float32": NAMED}
    return case(f"start-{kind}", "Starts", values=ROWS, quick="float64", refusal=refusal)(run)


_add("inverted", "A mirrored body recovers, is refused by the name of an element, or says that J <= 0.")
_add("flat", "A body pressed flat recovers, is refused by the name of an element, or says that J <= 0.")
_add("collapsed", "A body in one point recovers, is refused by the name of an element, or says that J <= 0.")
_add("random", "A scrambled body recovers, is refused by the name of an element, or says that J <= 0.")
