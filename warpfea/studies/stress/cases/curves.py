"""Beams given as functions: geometry of curves with many turns."""

import numpy as np

import warpfea as wf

from ..build import STEEL
from ..case import Answer, Setting, case

RADIUS, PITCH = 0.02, 0.005
"""Radius and pitch of the helix, m."""
ELEMENTS_PER_TURN = 24
"""Elements per turn, 15 degrees each."""
TANGENT_BOUND = 1e-6
"""Bounds of the angle of a tangent, rad, and of the length of dX/dxi, relative."""


@case("curves", "geometry", values=(10, 100, 160, 1000), quick="float64", dtypes=("float64",))
def helix_tangents(setting: Setting, turns: int) -> Answer:
    """A helix given as a function of s: tangents and lengths dX/dxi at the nodes against the exact ones."""
    turn = 2.0 * np.pi * turns

    def helix(s: float) -> tuple[float, float, float]:
        return RADIUS * np.cos(turn * s), RADIUS * np.sin(turn * s), PITCH * turns * s

    b = wf.ModelBuilder(gravity=(0, 0, 0))
    elements = ELEMENTS_PER_TURN * turns
    beam = b.add_beam(
        helix, elements=elements, section=wf.Rectangle(0.002, 0.002), normal=(0, 0, 1), material=STEEL, name="helix",
    )  # fmt: skip
    s = np.linspace(0.0, 1.0, elements + 1)
    slope = np.column_stack([-RADIUS * turn * np.sin(turn * s), RADIUS * turn * np.cos(turn * s),
                             np.full(len(s), PITCH * turns)])  # fmt: skip
    exact = np.stack([slope[:-1], slope[1:]], axis=1) / elements  # dX/dxi of each element at both ends, m
    assert beam.node_axes is not None
    assert beam.frames is not None
    made = np.einsum("enck,enk->enc", beam.node_axes[beam.mesh.cells], beam.frames[:, :, :, 0])
    length = np.linalg.norm(exact, axis=2)
    across = np.linalg.norm(np.cross(made, exact), axis=2)
    angle = float(np.arctan2(across, np.sum(made * exact, axis=2)).max())
    stretch = float(np.abs(np.linalg.norm(made, axis=2) / length - 1.0).max())
    off_curve = float(np.linalg.norm(beam.mesh.points - np.array([helix(k) for k in s]), axis=1).max() / RADIUS)
    return Answer(max(angle, stretch, off_curve), TANGENT_BOUND, "derivative of the helix",
                  note=f"angle {angle:.2g} rad, length {stretch:.2g}")  # fmt: skip
