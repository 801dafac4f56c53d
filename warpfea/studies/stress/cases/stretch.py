"""Homogeneous stretch far beyond linear theory."""

import numpy as np
from scipy.optimize import brentq

import warpfea as wf

from ..build import StepStats, relative_error, solve
from ..case import Answer, Setting, case

SHEAR_MODULUS, BULK_MODULUS = 4e5, 2e6


def _nominal_stress(stretches: np.ndarray) -> np.ndarray:
    """Principal nominal stresses (Pa) of Psi = mu/2 (I1bar - 3) + k/2 (J - 1)^2."""
    J = np.prod(stretches)
    return (
        SHEAR_MODULUS * J ** (-2.0 / 3.0) * (stretches - stretches @ stretches / (3.0 * stretches))
        + BULK_MODULUS * (J - 1) * J / stretches
    )


def _uniaxial_stretches(stretch: float) -> np.ndarray:
    """Stretches under uniaxial stress."""
    guess = stretch**-0.5
    state = np.array([stretch, guess, guess])

    def across(lateral: float) -> float:
        state[1:] = lateral
        return _nominal_stress(state)[1]

    state[1:] = brentq(across, guess, 3.0 * guess, xtol=1e-15, rtol=1e-14)
    return state


@case("stretch", "Large strain", values=[f"{e}-{s}" for e in ("T4", "T10", "H3843") for s in ("10", "0.05")],
      quick="both")  # fmt: skip
def stretch(setting: Setting, value: str) -> Answer:
    """A neo-Hookean cube stretched to 10 times its length, or compressed to a twentieth between walls.

    Without walls its free sides would wrinkle: uniaxial compression is unstable below a stretch of 0.444.
    """
    element, factor = value.split("-")
    walls = float(factor) < 1.0
    exact = np.array([float(factor), 1.0, 1.0]) if walls else _uniaxial_stretches(float(factor))
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_solid(wf.mesh.box((1, 1, 1), cells=(2, 2, 2), element=element), element=element,
                       material=wf.NeoHookean(mu=SHEAR_MODULUS, k=BULK_MODULUS))  # fmt: skip
    end = body.nodes("x+")
    for axis in "xyz":
        slots = "position"
        if element == "H3843":  # the side stays plane
            slots += "".join(f"+gradient-{other}" for other in "xyz" if other != axis)
        b.clamp(body.nodes(axis + "-"), slots=slots, components=axis)
        if axis != "x" and walls:
            b.clamp(body.nodes(axis + "+"), slots=slots, components=axis)
        elif axis == "x":
            b.drive(end, displacement=(float(factor) - 1.0, 0.0, 0.0), components="x", slots=slots)
    stats = StepStats()
    result = solve(b, setting, stats, load_steps=10).result
    error = relative_error(result.displacements(body)[0], body.mesh.points * (exact - 1.0))
    error = max(error, relative_error(result.reaction(end)[0, 0], _nominal_stress(exact)[0]))
    J = float(result.report.min_J[0])
    return Answer(error, 1e-4 if setting.single else 1e-8, "closed form of the law", **stats.answer_fields,
                  limits={"min J": (abs(J / np.prod(exact) - 1.0), 1e-4 if setting.single else 1e-8)})  # fmt: skip
