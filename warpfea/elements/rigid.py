"""Affine motion of a rigid part by the positions of four points, for all cells of its surface."""

from typing import Any

import numpy as np

from ..mesh.cells import barycentric, tet4_gradients
from .family import EnergyPart, Family, VtkSubdivision, register
from .lagrange import TET_CORNERS, TET_FACE_CORNERS
from .quadrature import TET_RULES, triangle_6

__all__ = ["RIGID"]


NOMINAL_SOFTNESS = 1e-2
"""Modulus of the element over that of a part's material for contact, where the part has none of its own."""


def _affine_functions(xi: np.ndarray, nodes: np.ndarray, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """s = [1, x, y, z] B and derivatives; frames: B (E, 4, 4), the inverse of the four points' rows [1, x, y, z]."""
    x = barycentric(xi) @ nodes
    dx = np.einsum("qnl,enk->eqlk", tet4_gradients(xi), nodes)
    s = frames[:, None, 0] + np.einsum("eqk,eks->eqs", x, frames[:, 1:])
    return s, np.einsum("eqlk,eks->eqsl", dx, frames[:, 1:])


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
