"""ANCF tetrahedra ENMC, FN, FN18 (Paper T) and the ANCF brick H3843: cubic solids with gradient slots.

ENMC: four corners with position and three gradients, four face centroids with a position: the complete cubic. FN: the
face centroids are eliminated, r_c = (r_1 + r_2 + r_3)/3 + c sum of the edge derivatives that leave the face's corners
(T-A.2), with c = 2/81 as printed, which reproduces linear fields only, or 1/18 (FN18), which reproduces all quadratics.
Slots are Cartesian gradients d/dX_k (Paper T's S* = S T). Its printed formulas are in `tests/paper_t.py`; a test
compares both.
"""

import functools
import itertools

import numpy as np

from ..mesh.cells import HEX_CORNERS, HEX_FACES
from .ancf import monomials, nodal_functions, nodal_shape_functions, to_node_axes
from .ancf_beam import box_subdivision
from .family import Family, ParentDomain, register
from .lagrange import QUADRATIC_SUBDIVISION, TET_CORNERS, TET_FACE_CORNERS, TET_FACES
from .quadrature import TET_RULES, box_rule, conical_tet, conical_triangle, square_rule

__all__ = ["BRICK", "ENMC", "FN", "FN18", "TET_CORNERS", "TET_FACES", "tet_functions"]

GRADIENT_SLOT_SETS = {"gradients": (1, 2, 3), "gradient-x": (1,), "gradient-y": (2,), "gradient-z": (3,)}
FACE_CENTROIDS = np.array([TET_CORNERS[list(f)].mean(axis=0) for f in TET_FACES])
CUBIC_EXPONENTS = np.array([p for p in itertools.product(range(4), repeat=3) if sum(p) <= 3])
"""Exponents (20, 3) of the monomials of the complete cubic."""


@functools.cache
def _enmc_inverse_basis() -> np.ndarray:
    b, db = monomials(CUBIC_EXPONENTS, TET_CORNERS)
    corner = np.moveaxis(np.concatenate([b[:, :, None], db], axis=2), 1, 0).reshape(len(CUBIC_EXPONENTS), -1)
    return np.linalg.inv(np.concatenate([corner, monomials(CUBIC_EXPONENTS, FACE_CENTROIDS)[0].T], axis=1))


@functools.cache
def _centroid_elimination(c: float) -> np.ndarray:
    """(20, 16) ENMC slots from FN slots, in parent gradients."""
    out = np.vstack([np.eye(16), np.zeros((4, 16))])
    for k, face in enumerate(TET_FACES):
        for a in face:
            out[16 + k, 4 * a] = 1.0 / 3.0
            for b in face:
                if b != a:
                    out[16 + k, 4 * a + 1 : 4 * a + 4] += c * (TET_CORNERS[b] - TET_CORNERS[a])
    return out


def tet_functions(xi: np.ndarray, elimination: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Functions in volume parameterisation: slots (r, r_xi, r_eta, r_zeta) of each corner, then the face centroids.

    Args:
        xi: (Q, 3) points of the unit tetrahedron.
        elimination: coefficient c of FN's face centroids; None for ENMC.

    Returns:
        s (Q, S) and ds/dxi (Q, S, 3), with S = 20 or 16.
    """
    C = _enmc_inverse_basis()
    if elimination is not None:
        C = _centroid_elimination(elimination).T @ C
    return nodal_functions(CUBIC_EXPONENTS, C, xi)


def _tet_shape_functions(
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


def _register_tet(name: str, cell: str, elimination: float | None) -> Family:
    points = np.vstack([TET_CORNERS, FACE_CENTROIDS]) if elimination is None else TET_CORNERS
    return register(
        Family(
            name=name,
            cell_type=cell,
            node_slots=((0, 1, 2, 3),) * 4 + (((0,),) * 4 if elimination is None else ()),
            shape=functools.partial(_tet_shape_functions, elimination),
            rules={"tet14": TET_RULES["tet14"], "conical4": conical_tet(4)},
            curved_rule=TET_RULES["tet14"],
            mass_rule=conical_tet(4),
            # on a curved body the cubic map makes degree 12 with FN, degree 9 with the others
            curved_mass_rule=conical_tet(7) if name == "FN" else conical_tet(5),
            vertices=TET_CORNERS,
            faces=TET_FACE_CORNERS,
            face_rule=conical_triangle(4),
            face_divisions=((3, 3),) * 4,
            node_samples=points[:, None],
            vtk_subdivision=QUADRATIC_SUBDIVISION,
            slot_sets=GRADIENT_SLOT_SETS,
        )
    )


ENMC = _register_tet("ENMC", "tetra_faces", None)
FN = _register_tet("FN", "tetra", 2.0 / 81.0)
FN18 = _register_tet("FN18", "tetra", 1.0 / 18.0)

LOW, HIGH = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
_rule = functools.partial(box_rule, ranges=tuple(zip(LOW, HIGH)))


def _brick_exponents() -> np.ndarray:
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


BRICK_EXPONENTS = _brick_exponents()


BRICK = register(
    Family(
        name="H3843",
        cell_type="hexahedron",
        node_slots=((0, 1, 2, 3),) * 8,
        shape=nodal_shape_functions(BRICK_EXPONENTS, HEX_CORNERS),
        rules={"3x3x3": _rule((3, 3, 3)), "4x4x4": _rule((4, 4, 4))},
        curved_rule=_rule((4, 4, 4)),
        mass_rule=_rule((5, 5, 5)),
        curved_mass_rule=_rule((5, 5, 5)),
        vertices=HEX_CORNERS[[0, 2, 5, 7]],
        parent=ParentDomain(LOW, HIGH),
        faces=tuple(HEX_CORNERS[HEX_FACES]),
        face_rule=square_rule(5),
        face_divisions=((3, 3),) * 6,
        node_samples=HEX_CORNERS[:, None],
        vtk_subdivision=box_subdivision(LOW, HIGH, (2, 2, 2)),
        slot_sets=GRADIENT_SLOT_SETS,
    )
)
