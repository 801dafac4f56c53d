"""Large bending in few load steps, with bounds on Newton iterations."""

import functools

import numpy as np

import warpfea as wf

from ..build import CLAMPED_SLOTS, beam, solve
from ..case import FLOAT32_REFUSAL, Answer, Setting, case

ELASTICA_TIP = np.array([-0.056432, -0.301721])
"""Displacement of the tip along and across, over the length, at F L^2 / (E I) = 1 (Mattiasson 1981)."""
ELASTICA_STEPS, ELASTICA_NEWTON = 5, 10
SLENDERNESS_RATIOS = (1e1, 1e2, 1e3, 1e4, 1e5)
SHEAR_BOUND = 2e-2
"""Bound of the error including shear, absent in the elastica, at L/h = 10."""
INNER, OUTER, THICKNESS = 6.0, 10.0, 0.03
ANNULUS_DEFLECTIONS = {"inner": 13.891, "outer": 17.528}
"""Deflection of the ends of the slit (Sze, Liu and Lo 2004, Finite Elem. Anal. Des. 40:1551), m."""
SLIT_FRACTION = 1e-6
"""Fraction of the full turn omitted at the slit."""
SOFT_LAW = wf.NeoHookean.from_E_nu(E=1e6, nu=0.4, density=1000.0)
MAX_NEWTON_SOFT = 80
CLAMPED_FRACTION = 0.03
"""Clamped fraction of the length, from the low end."""


@case("elastica", "bending", values=SLENDERNESS_RATIOS, quick="both", refusal=FLOAT32_REFUSAL)
def elastica(setting: Setting, slenderness: float) -> Answer:
    """A cantilever of 16 beam elements bent by F L^2 = E I in five load steps."""
    E, side = 2e11, 1.0 / slenderness
    b, body = beam(16, side, wf.SVK(E=E, nu=0.0))
    b.add_point_load(body.end, (0, 0, -E * side**4 / 12.0))
    found = solve(b, setting, load_steps=ELASTICA_STEPS)
    error = float(np.abs(found.tip[[0, 2]] - ELASTICA_TIP).max() / -ELASTICA_TIP[1])
    limits = {"Newton of a load step": (found.stats.newton / ELASTICA_STEPS, ELASTICA_NEWTON)}
    bound = SHEAR_BOUND if slenderness < 50.0 else 6e-3 if setting.single else 1e-3
    return found.stats.answer(error, bound, "elastica", limits=limits)


def annulus_map(X: np.ndarray) -> np.ndarray:
    """A sheet (radius, part of a turn) as a slit annular plate, m."""
    angle = 2.0 * np.pi * (1.0 - SLIT_FRACTION) * X[:, 1]
    return np.column_stack([X[:, 0] * np.cos(angle), X[:, 0] * np.sin(angle), X[:, 2]])


@case("annular", "bending", values=(3, "auto"), quick="float64", refusal=FLOAT32_REFUSAL)
def annular_plate(setting: Setting, load_steps: int | str) -> Answer:
    """The slit annular plate of Sze: one side of the slit is lifted by 0.8 N/m, the other clamped."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    mesh = wf.mesh.grid((OUTER - INNER, 1.0), cells=(4, 32), origin=(INNER, 0.0, 0.0), map=annulus_map)
    body = b.add_shell(mesh, thickness=THICKNESS, material=wf.SVK(E=21e6, nu=0.0), name="annulus")
    b.clamp(body.edge("y-"), slots=CLAMPED_SLOTS["3443"])
    b.add_traction(body.surface("y+"), (0, 0, 0.8 / THICKNESS))
    ends = body.edge("y+").indices
    radius = np.linalg.norm(mesh.points[ends], axis=1)
    found = solve(b, setting, load_steps=load_steps)
    lift = found.result.displacements(body)[0, ends, 2]
    values = {"inner": lift[np.argmin(radius)], "outer": lift[np.argmax(radius)]}
    error = max(abs(values[at] / ANNULUS_DEFLECTIONS[at] - 1.0) for at in ANNULUS_DEFLECTIONS)
    limits = {"Newton": (found.stats.newton, 150)}
    note = f"inner {values['inner']:.3f} m, outer {values['outer']:.3f} m"
    return found.stats.answer(error, 2e-2, "Sze's 13.891 and 17.528 m", limits=limits, note=note)


def solve_soft_solid(setting: Setting, name: str) -> Answer:
    """Answer of a soft solid, clamped at the low end of its longest axis, under its weight: the reaction equals it."""
    mesh = wf.mesh.read(setting.mesh(f"{name}.msh"))
    low, high = mesh.bounding_box()
    axis = int(np.argmax(high - low))
    length = float(high[axis] - low[axis])
    gravity = np.zeros(3)
    gravity[(axis + 1) % 3] = -2.0 / length
    b = wf.ModelBuilder(gravity=tuple(gravity))
    body = b.add_solid(mesh, material=SOFT_LAW, name="solid")
    clamped = body.nodes(lambda X: X[:, axis] <= low[axis] + CLAMPED_FRACTION * length)
    b.clamp(clamped)
    weight = SOFT_LAW.density * mesh.volume() * gravity
    found = solve(b, setting, load_steps=2)
    reaction = found.result.reaction(clamped)[0]
    error = float(np.abs(reaction + weight).max() / np.abs(weight).max())
    limits = {"Newton": (found.stats.newton, MAX_NEWTON_SOFT)}
    return found.stats.answer(error, 1e-3 if setting.single else 1e-6, "the wall carries the weight", limits=limits)


for _name, _what in {"mat": "mat", "dolphin": "dolphin", "thin_limbs": "body with thin limbs"}.items():
    _text = f"A neo-Hookean {_what} of unstructured T4 bends by most of its length in two load steps."
    _trial = functools.partial(solve_soft_solid, name=_name)
    case(f"soft-{_name.replace('_', '-')}", "soft solids", description=_text)(_trial)
