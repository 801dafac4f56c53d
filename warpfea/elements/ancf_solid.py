"""ANCF tetrahedra ENMC, FN, FN18 (Paper T) and the ANCF brick H3843: cubic solids with gradient slots.

ENMC: four corners with position and three gradients, four face centroids with a position: the complete cubic. FN: the
face centroids are eliminated, r_c = (r_1 + r_2 + r_3)/3 + c sum of the edge derivatives that leave the face's corners
(T-A.2), with c = 2/81 as printed, which reproduces linear fields only, or 1/18 (FN18), which reproduces all quadratics.
Slots are Cartesian gradients d/dX_k (Paper T's S* = S T). Its printed formulas are in `tests/paper_t.py`; a test
compares both.
"""

from __future__ import annotations

import functools
import itertools

import numpy as np

from .ancf import monomials, nodal_basis, nodal_functions, to_node_axes
from .ancf_beam import box_lattice
from .family import Family, Parent, register
from .lagrange import CORNERS, FACES, QUADRATIC, TET_SIDES
from .quadrature import TET_RULES, box_rule, conical_tet, conical_triangle, square_rule

__all__ = ["BRICK", "CORNERS", "ENMC", "FACES", "FN", "FN18", "tet_functions"]

GRADIENTS = {"gradients": (1, 2, 3), "gradient-x": (1,), "gradient-y": (2,), "gradient-z": (3,)}
CENTROIDS = np.array([CORNERS[list(f)].mean(axis=0) for f in FACES])
CUBIC = np.array([p for p in itertools.product(range(4), repeat=3) if sum(p) <= 3])


@functools.cache
def _enmc_inverse() -> np.ndarray:
    b, db = monomials(CUBIC, CORNERS)
    corner = np.moveaxis(np.concatenate([b[:, :, None], db], axis=2), 1, 0).reshape(len(CUBIC), -1)
    return np.linalg.inv(np.concatenate([corner, monomials(CUBIC, CENTROIDS)[0].T], axis=1))


@functools.cache
def _elimination(c: float) -> np.ndarray:
    """(20, 16) ENMC slots from FN slots, in parent gradients."""
    out = np.vstack([np.eye(16), np.zeros((4, 16))])
    for k, face in enumerate(FACES):
        for a in face:
            out[16 + k, 4 * a] = 1.0 / 3.0
            for b in face:
                if b != a:
                    out[16 + k, 4 * a + 1 : 4 * a + 4] += c * (CORNERS[b] - CORNERS[a])
    return out


def tet_functions(xi: np.ndarray, elimination: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Functions in volume parameterisation: slots (r, r_xi, r_eta, r_zeta) of each corner, then the face centroids.

    Args:
        xi: (Q, 3) points of the unit tetrahedron.
        elimination: coefficient c of FN's face centroids; None for ENMC.

    Returns:
        s (Q, S) and ds/dxi (Q, S, 3), with S = 20 or 16.
    """
    C = _enmc_inverse()
    if elimination is not None:
        C = _elimination(elimination).T @ C
    return nodal_functions(CUBIC, C, xi)


def _tet_shape(
    elimination: float | None, xi: np.ndarray, nodes: np.ndarray, frames: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    s, ds = tet_functions(xi, elimination)
    a, da = to_node_axes(s[:, :16], ds[:, :16], frames[:, :4])
    if elimination is not None:
        return a, da
    E = len(frames)
    return (
        np.concatenate([a, np.broadcast_to(s[None, :, 16:], (E, *s[:, 16:].shape))], axis=2),
        np.concatenate([da, np.broadcast_to(ds[None, :, 16:], (E, *ds[:, 16:].shape))], axis=2),
    )


def _tet(name: str, cell: str, elimination: float | None) -> Family:
    points = np.vstack([CORNERS, CENTROIDS]) if elimination is None else CORNERS
    return register(
        Family(
            name=name,
            cell_type=cell,
            node_slots=((0, 1, 2, 3),) * 4 + (((0,),) * 4 if elimination is None else ()),
            shape=functools.partial(_tet_shape, elimination),
            rules={"tet14": TET_RULES["tet14"], "conical4": conical_tet(4)},
            curved_rule=TET_RULES["tet14"],
            mass_rule=conical_tet(4),
            # on a curved body the cubic map makes degree 12 with FN, degree 9 with the others
            curved_mass_rule=conical_tet(7) if name == "FN" else conical_tet(5),
            vertices=CORNERS,
            affine=False,
            parent=Parent(),
            faces=TET_SIDES,
            face_rule=conical_triangle(4),
            divisions=((3, 3),) * 4,
            node_samples=points[:, None],
            vtk_subdivision=QUADRATIC,
            slot_sets=GRADIENTS,
        )
    )


ENMC = _tet("ENMC", "tetra_faces", None)
FN = _tet("FN", "tetra", 2.0 / 81.0)
FN18 = _tet("FN18", "tetra", 1.0 / 18.0)

HEX = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)], dtype=float)
HEX_SIDES = tuple(
    HEX[list(f)] for f in ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))
)
LOW, HIGH = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
UNIT = tuple(zip(LOW, HIGH))


def _brick_powers() -> np.ndarray:
    """Exponents (32, 3): the trilinear monomials, and for each direction its square and cube times the bilinear ones of
    the two others."""
    out = list(itertools.product((0, 1), repeat=3))
    for k in range(3):
        for high in (2, 3):
            for pair in itertools.product((0, 1), repeat=2):
                p = list(pair)
                p.insert(k, high)
                out.append(tuple(p))
    return np.array(out)


BRICK_POWERS = _brick_powers()


@functools.cache
def _brick_inverse() -> np.ndarray:
    return nodal_basis(BRICK_POWERS, HEX)


def _brick_shape(xi: np.ndarray, nodes: np.ndarray, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return to_node_axes(*nodal_functions(BRICK_POWERS, _brick_inverse(), xi), frames)


BRICK = register(
    Family(
        name="H3843",
        cell_type="hexahedron",
        node_slots=((0, 1, 2, 3),) * 8,
        shape=_brick_shape,
        rules={"3x3x3": box_rule((3, 3, 3), UNIT), "4x4x4": box_rule((4, 4, 4), UNIT)},
        curved_rule=box_rule((4, 4, 4), UNIT),
        mass_rule=box_rule((5, 5, 5), UNIT),
        curved_mass_rule=box_rule((5, 5, 5), UNIT),
        vertices=HEX[[0, 2, 5, 7]],
        affine=False,
        parent=Parent(LOW, HIGH),
        faces=HEX_SIDES,
        face_rule=square_rule(5),
        divisions=((3, 3),) * 6,
        node_samples=HEX[:, None],
        vtk_subdivision=box_lattice(LOW, HIGH, (2, 2, 2)),
        slot_sets=GRADIENTS,
    )
)
