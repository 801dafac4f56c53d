"""Bars compressed, stretched and twisted close to element inversion."""

import functools

import numpy as np

import warpfea as wf

from ..build import CLAMPED_SLOTS, MIN_POSITIVE_J, bar, solve
from ..case import FLOAT32_REFUSAL, Answer, Setting, case

SIZE = (1.0, 0.1, 0.1)
CELLS = {"T4": (20, 2, 2), "T10": (20, 2, 2), "FN18": (20, 2, 2), "H3843": (20, 1, 1)}
STRETCHED_CELLS = CELLS | {"T10": (10, 1, 1), "FN18": (10, 1, 1)}
"""Cells of the neo-Hookean bar stretched tenfold, which takes minutes with finer ones."""
SVK = wf.SVK(E=1e6, nu=0.3, density=1000.0)
NEO_HOOKEAN = wf.NeoHookean.from_E_nu(E=1e6, nu=0.3, density=1000.0)
REFUSAL_TEXTS = ["inverted", "unstable equilibrium"]
"""Accepted refusal: a limit point past which a bar snaps into an inverted state."""
SVK_REFUSAL = {"float64": REFUSAL_TEXTS, "float32": [*REFUSAL_TEXTS, "float32"]}
END_DISPLACEMENTS = {"squeezed": -0.95, "stretched": 9.0}
"""Displacement of the driven end along the bar, m."""
TWIST_TURNS = 4.0
BALANCE_BOUNDS = {"float64": 1e-6, "float32": 1e-3}
"""Bound of the sum of the forces at both ends, over the larger."""
MIN_STRETCHED_J = 0.35
"""Minimum J of the neo-Hookean bar stretched tenfold, at integration points."""


def pressed_bar(element: str) -> tuple[wf.ModelBuilder, wf.Body]:
    """An SVK bar under a pressure of ten times its modulus, guided along its axis to prevent buckling."""
    b, body = bar(element, CELLS[element], SIZE, SVK)
    b.clamp(body.nodes(lambda X: X[:, 0] > -1.0), slots="all", components="yz")
    b.add_traction(body.surface("x+"), (-1e7, 0, 0))
    return b, body


def driven_bar(element: str, law: wf.SVK | wf.NeoHookean, how: str) -> tuple[wf.ModelBuilder, wf.Body]:
    """A bar with fully clamped ends, one of them driven: compressed, stretched or twisted."""
    cells = STRETCHED_CELLS if law is NEO_HOOKEAN and how == "stretched" else CELLS
    b, body = bar(element, cells[element], SIZE, law)
    slots = CLAMPED_SLOTS[element]
    if how == "twisted":
        turn = wf.Rotation(anchor=(0, 0.05, 0.05), axis=(1, 0, 0), angle=([0, 1], [0, 2.0 * np.pi * TWIST_TURNS]))
        b.drive(body.nodes("x+"), rotation=turn, slots=slots)
    else:
        slots = slots.replace("all", "position")
        b.drive(body.nodes("x+"), displacement=([0, 1], [(0, 0, 0), (END_DISPLACEMENTS[how], 0, 0)]), slots=slots)
    return b, body


def force_balance(setting: Setting, element: str, law: wf.SVK | wf.NeoHookean, how: str) -> Answer:
    """Answer of such a bar: the forces at its ends are opposite, and J is at least a lower bound everywhere."""
    lowest_J = MIN_STRETCHED_J if law is NEO_HOOKEAN and how == "stretched" else MIN_POSITIVE_J
    b, body = driven_bar(element, law, how)
    found = solve(b, setting, load_steps=40)
    ends = [found.result.reaction(body.nodes(side))[0] for side in ("x-", "x+")]
    scale = max(float(np.abs(ends).max()), 1e-6 * law.lame[1] * SIZE[1] * SIZE[2])
    error = float(np.abs(ends[0] + ends[1]).max()) / scale
    stats = found.stats
    reference = "forces of both ends are opposite"
    bound, note = BALANCE_BOUNDS[setting.dtype], f"min J {stats.min_J:.3g}"
    return stats.answer(error, bound, reference, lowest_J=lowest_J, note=note)


@case("inverted-traction", "inside out", values=tuple(CELLS), quick="float64", refusal=SVK_REFUSAL, must_refuse=True)
def inverted_traction(setting: Setting, element: str) -> Answer:
    """A guided SVK bar under a pressing traction ten times its modulus, without an admissible equilibrium."""
    found = solve(pressed_bar(element)[0], setting)
    return found.stats.answer(0.0, 0.0, "SVK softens: no state with J > 0", note=f"min J {found.stats.min_J:.3g}")


@case("inverted-report", "inside out")
def inverted_report(setting: Setting) -> Answer:
    """The guided bar with inversion="report": the state is returned, reported as inverted."""
    b, body = pressed_bar("T10")
    found = solve(b, setting, inversion="report")
    end = found.result.reaction(body.nodes("x-"))[0, 0]
    load = 1e7 * SIZE[1] * SIZE[2]
    limits = {"min J": (found.stats.min_J, 0.0)}
    error = abs(end / load - 1.0)
    reference = "the wall carries the load"
    return found.stats.answer(error, BALANCE_BOUNDS[setting.dtype], reference, lowest_J=None, limits=limits)


for _name, _law, _refusal, _text in (
    ("inverted-squeezed", SVK, SVK_REFUSAL, "An SVK bar compressed to a twentieth: correct with J > 0, or refused."),
    ("inverted-stretched", SVK, SVK_REFUSAL, "An SVK bar stretched tenfold: correct with J > 0, or refused."),
    ("inverted-twisted", SVK, SVK_REFUSAL, "An SVK bar twisted by four turns: correct with J > 0, or refused."),
    ("neo-squeezed", NEO_HOOKEAN, FLOAT32_REFUSAL,
     "A neo-Hookean bar compressed to a twentieth: a solution is required."),
    ("neo-stretched", NEO_HOOKEAN, FLOAT32_REFUSAL,
     "A neo-Hookean bar stretched tenfold: a solution is required, with J >= 0.35 at its points."),
    ("neo-twisted", NEO_HOOKEAN, FLOAT32_REFUSAL, "A neo-Hookean bar twisted by four turns: a solution is required."),
):  # fmt: skip
    _trial = functools.partial(force_balance, law=_law, how=_name.partition("-")[2])
    case(_name, "inside out", values=tuple(CELLS), refusal=_refusal, description=_text)(_trial)
