"""Inadmissible initial states: inverted, flat, collapsed to a point, scrambled."""

import functools

import numpy as np

import warpfea as wf

from ..build import StepStats, add_along_x, finalize
from ..case import Answer, Setting, case

MODULUS = 1e6
SOLIDS = ("T4", "T10", "ENMC", "FN18", "H3843")
ELEMENT_LAWS = [f"{e}-{law}" for e in SOLIDS for law in ("svk", "neo")] + ["3243-svk", "3443-svk"]

REFUSAL_TEXTS = ("worst element", "J <= 0")
"""Texts of refusals, which name the element."""


def _body(b: wf.ModelBuilder, element: str, law: str) -> wf.Body:
    """A body 1 m long along x, clamped at x = 0."""
    material = (wf.SVK if law == "svk" else wf.NeoHookean).from_E_nu(E=MODULUS, nu=0.3, density=1000.0)
    width, height = {"3243": (0.1, 0.1), "3443": (0.5, 0.05)}.get(element, (0.4, 0.4))
    body, start, _ = add_along_x(b, element, (4, 2, 2), (1.0, width, height), material)
    b.clamp(start)
    return body


def _initial_values(kind: str, body: wf.Body) -> np.ndarray:
    """Slot values (slots, 3) of an initial state, positions relative to the body's centre."""
    reference = body.reference
    if kind == "inverted":
        return reference * (-1.0, 1.0, 1.0)
    if kind == "flat":
        return reference * (1.0, 1.0, 0.0)
    if kind == "collapsed":
        return 0.0 * reference
    size = np.where(body.slot_kind == 0, 0.05, 0.3)[:, None]
    if body.materials[0][1].law != "svk":  # no inverted point
        size = 0.06 * size
    return reference + size * np.random.default_rng(0).standard_normal(reference.shape)


def _release(setting: Setting, value: str, kind: str, damped: bool) -> Answer:
    """Release an initial state without load; error: distance of the end from rest, over the length."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = _body(b, *value.split("-"))
    model = finalize(b, setting)
    state = model.state()
    u = (_initial_values(kind, body) - body.reference) * model.free_slots[body.slot_range]
    state.displacement.assign(u[None].astype(state.displacement.numpy().dtype))
    stats = StepStats()
    bound = 1e-4 if setting.single else 1e-6
    # the rest state is stress-free: the force scale is round-off of the forces at a strain of 1
    area = {"3243": 0.01, "3443": 0.025}.get(body.family.name, 0.16)
    solver = wf.NewtonPCG(max_newton=200, max_pcg=20000, force_tol=(2e-7 if setting.single else 1e-12) * MODULUS * area)
    if damped:  # omega h > 6 for the slowest mode: a step of backward Euler leaves less than a sixth of any mode
        h = 4.0 if body.family.name in ("3243", "3443") else 0.5
        sim = wf.Simulation(model, state, dt=h, solver=solver)
        stats.step(sim, 30)
    else:
        sim = wf.solve_static(model, load_steps=1, state=state, solver=solver, outputs=[stats]).simulation
    assert sim.last is not None
    low = float(sim.last.min_J[0])
    away = float(np.abs(sim.displacements(body)).max())
    values = stats.answer_fields | {"min_J": low}
    if low <= 0.0:
        return Answer(0.0, bound, "min_J <= 0 is reported", **values, note=f"stays so, {away:.2g} m off; reported")
    return Answer(away, bound, "rest", **values, note="recovered" if away <= bound else "another equilibrium")


for _kind, _what in (
    ("inverted", "A mirrored body"),
    ("flat", "A body pressed flat"),
    ("collapsed", "A body in one point"),
    ("random", "A scrambled body"),
):
    for _suffix, _quick, _way in (("", "float64", "statics"), ("-damped", "none", "damped steps")):
        _text = f"{_what}, by {_way}: recovers, is refused by the name of an element, or says that J <= 0."
        _trial = functools.partial(_release, kind=_kind, damped=bool(_suffix))
        case(f"start-{_kind}{_suffix}", "Starts", values=ELEMENT_LAWS, quick=_quick, refusal=REFUSAL_TEXTS,
             description=_text)(_trial)  # fmt: skip
