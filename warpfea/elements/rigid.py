"""Affine motion of a rigid part by the positions of four points, for all cells of its surface."""

from typing import Any

import numpy as np

from ..mesh.cells import barycentric, tet4_gradients
from .family import EnergyPart, Family, VtkSubdivision, register
from .lagrange import TET_CORNERS, TET_FACE_CORNERS
from .quadrature import TET_RULES, triangle_6

__all__ = ["NOMINAL_PERIOD", "RIGID", "TRIANGLE_SIDES", "deviations_through"]

TRIANGLE_SIDES = ((0, 1), (1, 2), (2, 0))

NOMINAL_PERIOD = 1e-2
"""Time, s, in which a wave would pass the element whose strains are constrained to zero: its stiffness scales the
system of a part that is held by others, and acts on no motion. In longer steps the time is theirs."""
NOMINAL_SOFTNESS = 1e-2
"""Modulus of the element over that of a part's material for contact, where the part has none of its own."""


def _affine_functions(xi: np.ndarray, nodes: np.ndarray, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """s = [1, x, y, z] B and derivatives.

    Args:
        frames: (E, 4 or 11, 4) B, the inverse of the four points' rows [1, x, y, z]; below it the deviations of the
            control points of face 0 from a flat one, of curved surfaces, m, with a column of zeros.
    """
    L, dL = barycentric(xi), tet4_gradients(xi)
    x = L @ nodes
    dx = np.einsum("qnl,enk->eqlk", dL, nodes)
    if frames.shape[1] > 4:
        C, dC = cubic_deviations(L[:, :3])
        x = x + np.einsum("qc,eck->eqk", C, frames[:, 4:, :3])
        dx = dx + np.einsum("qcn,qnl,eck->eqlk", dC, dL[:, :3], frames[:, 4:, :3])
    s = frames[:, None, 0] + np.einsum("eqk,eks->eqs", x, frames[:, 1:4])
    return s, np.einsum("eqlk,eks->eqsl", dx, frames[:, 1:4])


def cubic_deviations(L: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cubic Bernstein polynomials (Q, 7) of a triangle but for those of the corners, and derivatives (Q, 7, 3), at
    L (Q, 3): two of each of the `TRIANGLE_SIDES`, nearer to its first end and to its second, and that of the middle."""
    C, dC = [], []
    for i, j in (pair for side in TRIANGLE_SIDES for pair in (side, side[::-1])):
        d = np.zeros((len(L), 3))
        d[:, i], d[:, j] = 6.0 * L[:, i] * L[:, j], 3.0 * L[:, i] ** 2
        C.append(3.0 * L[:, i] ** 2 * L[:, j])
        dC.append(d)
    C.append(6.0 * np.prod(L, axis=1))
    dC.append(6.0 * np.roll(L, -1, axis=1) * np.roll(L, 1, axis=1))
    return np.stack(C, axis=1), np.stack(dC, axis=1)


def deviations_through(x: np.ndarray, side_points: np.ndarray, middle: np.ndarray | None) -> np.ndarray:
    """Deviations (T, 7, 3) of the control points of triangles x (T, 3, 3) whose sides pass through side_points
    (T, 3, 2, 3) at their thirds, and the middle of the surface through `middle` (T, 3); None: as flat as the sides
    allow."""
    ends = np.stack([x[:, list(side)] for side in TRIANGLE_SIDES], axis=1)
    off = side_points - np.einsum("pn,tsnk->tspk", np.array([(2.0, 1.0), (1.0, 2.0)]) / 3.0, ends)
    sides = np.einsum("cp,tspk->tsck", np.array([(3.0, -1.5), (-1.5, 3.0)]), off).reshape(len(x), 6, 3)
    center = sides.sum(axis=1) / 4.0 if middle is None else 4.5 * (middle - x.mean(axis=1)) - sides.sum(axis=1) / 2.0
    return np.concatenate([sides, center[:, None]], axis=1)


def _nominal_law(material: Any) -> tuple[str, tuple[float, ...]]:
    """St. Venant-Kirchhoff with nu = 0 and the part's modulus: no energy in a rotation."""
    modulus = getattr(material, "rigid_modulus", 2.0 * NOMINAL_SOFTNESS * material.lame[1])
    return "svk", (0.0, 0.5 * modulus)


RIGID = register(
    Family(
        name="rigid",
        cell_type="tetra",
        node_slots=((0,),) * 4,
        shape=_affine_functions,
        rules={"tet1": TET_RULES["tet1"]},
        schemes={"rigid": (EnergyPart("rigid", TET_RULES["tet1"], law=_nominal_law),)},
        curved_rule=TET_RULES["tet1"],
        mass_rule=TET_RULES["tet4"],
        curved_mass_rule=TET_RULES["tet4"],
        vertices=TET_CORNERS,
        faces=TET_FACE_CORNERS,
        face_rule=triangle_6(),
        face_divisions=((1, 1),) * 4,
        node_samples=TET_CORNERS[:, None],
        vtk_subdivision=VtkSubdivision(TET_CORNERS, "tetra", np.arange(4)[None]),
        rigid=True,
    )
)
