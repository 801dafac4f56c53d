"""Paper T's printed equations of the ANCF tetrahedra: the tests check the tables of `ancf_solid` against them.

A.n: appendix of Pappalardo, Wang, Shabana, Nonlinear Dyn. 89 (2017) 2905-2932. Corners, edges and faces count from 0
here and from 1 in the paper. Conventions:

- Volume coordinates ``lam`` (Q, 4) = (xi, eta, zeta, chi), one per corner, of sum 1; dimensionless.
- Volume slots: at corner i the position r, then the derivatives along the edges to corners i+1, i+2, i+3 (modulo 4),
  dr/dlam_j - dr/dlam_i for the edge i -> j, in the unit of r: edge i -> j is slot 4 i + (j - i) % 4. Then, ENMC only,
  the positions at the centroids of faces 123, 124, 234, 134: the order of `ancf_solid.TET_FACES`.
- Cartesian slots: at corner i r, r_x, r_y, r_z, then the same centroids: the library's order already.

The appendix leaves out the definition of the volume gradients, the g_k of A.1, the matrix T of S* = S T and the
coefficients of A.15. They are derived here: g_k from the pattern of A.1, the gradients and T from A.1 against A.3,
A.15 by re-expansion.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable

import numpy as np

from warpfea.elements.ancf_solid import TET_CORNERS, TET_FACES

PRINTED = 2.0 / 81.0
"""Face-centroid coefficient c of A.2, A.4 and A.5; 1/18 in its place reproduces all quadratics (FN18)."""

# A.1 as printed, counting from 1: the slots along edges are g_a/3 - (g_b + g_c)/6 with (a, b, c) of this table, row by
# corner. A.2 adds c (s_b + s_c) to the same slots.
A1_EDGES = (
    ((5, 17, 18), (9, 17, 20), (11, 18, 20)),
    ((7, 17, 19), (13, 18, 19), (6, 17, 18)),
    ((15, 19, 20), (10, 17, 20), (8, 17, 19)),
    ((12, 18, 20), (14, 18, 19), (16, 19, 20)),
)
# faces at each corner, in A.1 with the factor -7/6, in A.2 with 1/3
A1_FACES = ((17, 18, 20), (17, 18, 19), (17, 19, 20), (18, 19, 20))

# Edges i -> j in the order of g_5 .. g_16 (3 lam_i^2 lam_j) and of h_5 .. h_16
PAIRS = ((0, 1), (1, 0), (1, 2), (2, 1), (0, 2), (2, 0), (0, 3), (3, 0), (1, 3), (3, 1), (2, 3), (3, 2))

LATTICE = np.array(
    [[3 * (i == n) for n in range(4)] for i in range(4)]
    + [[2 * (i == n) + (j == n) for n in range(4)] for i, j in PAIRS]
    + [[int(n in face) for n in range(4)] for face in TET_FACES]
)
"""(20, 4) exponents of g_k; LATTICE / 3 are the points of the control net."""
_MULTIPLICITY = np.array([1.0] * 4 + [3.0] * 12 + [6.0] * 4)  # 3! / (exponents' factorials)

POWERS = np.array(
    [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (2, 0, 0), (0, 2, 0), (0, 0, 2), (1, 1, 0), (0, 1, 1), (1, 0, 1)]
    + [(3, 0, 0), (0, 3, 0), (0, 0, 3), (2, 1, 0), (1, 2, 0), (0, 2, 1), (0, 1, 2), (2, 0, 1), (1, 0, 2), (1, 1, 1)]
)
"""(20, 3) exponents of (x, y, z) in A.15's order."""


def _others(i: int) -> tuple[int, int, int]:
    """Corners at the ends of i's edges, in the order of the slots."""
    return (i + 1) % 4, (i + 2) % 4, (i + 3) % 4


def _edge(i: int, j: int) -> int:
    """Volume slot of the derivative along i -> j."""
    return 4 * i + (j - i) % 4


# --- volume coordinates -------------------------------------------------------------------------------------------


def _six_volumes(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(4,) 6 V_i of A.6 and (4, 3) L_i of A.7-A.10: both alternate in sign over i."""
    V, L = np.empty(4), np.empty((4, 3))
    for i in range(4):
        a, b, c = (corners[n] for n in range(4) if n != i)
        V[i] = (-1) ** i * np.dot(a, np.cross(b, c))
        L[i] = -((-1) ** i) * (np.cross(a, b) + np.cross(b, c) + np.cross(c, a))
    return V, L


def signed_volume(corners: np.ndarray) -> float:
    """V = V_1 + V_2 + V_3 + V_4 of A.6 = det[r_2 - r_1, r_3 - r_1, r_4 - r_1] / 6, in length^3.

    Args:
        corners: (4, 3) straight tetrahedron; the sign follows the order of its corners.
    """
    return float(_six_volumes(corners)[0].sum() / 6.0)


def _linear_forms(corners: np.ndarray) -> np.ndarray:
    """(4, 4) coefficients of 1, x, y, z in each volume coordinate, A.13."""
    V, L = _six_volumes(corners)
    return np.hstack([V[:, None], L]) / V.sum()


def volume_coordinates(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Volume coordinates by A.13, for either orientation of the corners.

    Args:
        points: (Q, 3), inside the tetrahedron or not.
        corners: (4, 3), of volume other than 0.

    Returns:
        (Q, 4), dimensionless.
    """
    return np.hstack([np.ones((len(points), 1)), points]) @ _linear_forms(corners).T


# --- Bezier -------------------------------------------------------------------------------------------------------


def bernstein(lam: np.ndarray) -> np.ndarray:
    """g_1 .. g_20 of A.1, the cubic Bernstein polynomials, (Q, 20).

    The order is not printed; A.1 fixes it: lam_i^3, then 3 lam_i^2 lam_j for the edges 12, 21, 23, 32, 13, 31, 14, 41,
    24, 42, 34, 43, then 6 lam_i lam_j lam_k for the faces 123, 124, 234, 134.
    """
    return _MULTIPLICITY * np.prod(lam[:, None, :] ** LATTICE, axis=2)


def bezier_map(c: float | None = None) -> np.ndarray:
    """Control points from nodal coordinates in volume slots, M of S = B M: (20, 20) of ENMC, or (20, 16) of FN with c.

    Derived from the meaning of control points, not from A.1: r_i at corners, r_i + r_(i -> j) / 3 on edges, and on
    faces the point that puts the cubic's centroid at r_c; for FN, r_c = sum r_i / 3 + c sum r_(i -> j) over the face.
    """
    M = np.zeros((20, 20 if c is None else 16))
    for i in range(4):
        M[i, 4 * i] = 1.0
    for k, (i, j) in enumerate(PAIRS, start=4):
        M[k, 4 * i] = 1.0
        M[k, _edge(i, j)] = 1.0 / 3.0
    for k, face in enumerate(TET_FACES, start=16):
        # at the centroid g is 1/27, 3/27, 6/27: p = (27 r_c - sum of corners - 3 sum of edge points) / 6
        if c is None:
            M[k, k] = 27.0 / 6.0
        for i in face:
            M[k, 4 * i] = -7.0 / 6.0 if c is None else 1.0 / 3.0
            for j in face:
                if i != j:
                    M[k, _edge(i, j)] = (0.0 if c is None else 4.5 * c) - 1.0 / 6.0
    return M


def bezier_coefficients(functions: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """(20, S) control values of cubics given as (Q, 4) -> (Q, S): functions = bernstein @ result."""
    points = LATTICE / 3.0
    return np.linalg.solve(bernstein(points), functions(points))


# --- shape functions, volume parameterisation ---------------------------------------------------------------------


def enmc_volume(lam: np.ndarray) -> np.ndarray:
    """ENMC by A.1, volume slots: (Q, 4) -> (Q, 20)."""
    g = np.vstack([np.full(len(lam), np.nan), bernstein(lam).T])  # counts from 1, as printed
    out = []
    for i in range(4):
        corner = g[1 + i] - 7.0 / 6.0 * sum(g[f] for f in A1_FACES[i])
        out.append(corner + sum(g[a] for a, _, _ in A1_EDGES[i]))
        out += [g[a] / 3.0 - (g[f] + g[h]) / 6.0 for a, f, h in A1_EDGES[i]]
    out += [4.5 * g[f] for f in (17, 18, 19, 20)]
    return np.stack(out, axis=1)


def fn_volume(lam: np.ndarray, c: float = PRINTED) -> np.ndarray:
    """FN by A.2, volume slots: (Q, 4) -> (Q, 16)."""
    s = enmc_volume(lam)
    for i in range(4):
        s[:, 4 * i] += sum(s[:, f - 1] for f in A1_FACES[i]) / 3.0
        for m, (_, f, h) in enumerate(A1_EDGES[i], start=1):
            s[:, 4 * i + m] += c * (s[:, f - 1] + s[:, h - 1])
    return s[:, :16]


# --- shape functions, Cartesian gradients -------------------------------------------------------------------------


def _cartesian(lam: np.ndarray, corners: np.ndarray, pairs: float, side: float) -> list[np.ndarray]:
    """Corner slots common to A.3 and A.4, which differ in the factors of the other corners' products and on edges."""
    out = []
    for i in range(4):
        others = _others(i)
        p, (q, r, s) = lam[:, i], (lam[:, n] for n in others)
        out.append(p * (p**2 + 3.0 * p * (q + r + s) + pairs * (q * r + s * (q + r))))
        edge = [p * q * (p + side * (r + s)), p * r * (p + side * (s + q)), p * s * (p + side * (q + r))]
        for k in range(3):  # a, b, c of A.11 for x, y, z
            out.append(sum((corners[n, k] - corners[i, k]) * e for n, e in zip(others, edge)))
    return out


def enmc_cartesian(lam: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """ENMC by A.3, Cartesian slots: (Q, 4), (4, 3) -> (Q, 20); slots of gradients in length, others dimensionless."""
    faces = [27.0 * np.prod(lam[:, list(face)], axis=1) for face in TET_FACES]
    return np.stack(_cartesian(lam, corners, -7.0, -1.0) + faces, axis=1)


def fn_cartesian(lam: np.ndarray, corners: np.ndarray, c: float = PRINTED) -> np.ndarray:
    """FN by A.4, Cartesian slots: (Q, 4), (4, 3) -> (Q, 16).

    Printed for c = 2/81: (1/3) lam_i lam_j (3 lam_i - lam_k - lam_l) on edges. For other c the -1 becomes 81 c - 3
    (derived from A.5).
    """
    return np.stack(_cartesian(lam, corners, 2.0, (81.0 * c - 3.0) / 3.0), axis=1)


def fn_from_enmc_cartesian(lam: np.ndarray, corners: np.ndarray, c: float = PRINTED) -> np.ndarray:
    """FN by A.5 from the functions of A.3, Cartesian slots: (Q, 4), (4, 3) -> (Q, 16).

    alpha, beta, gamma of A.12 are the components of r_j + r_k - 2 r_i. Its index condition, i != j and i != h, lacks
    j != h; A.5 uses distinct indices only.
    """
    s = enmc_cartesian(lam, corners)
    for f, face in enumerate(TET_FACES, start=16):
        for i in face:
            s[:, 4 * i] += s[:, f] / 3.0
            alpha = corners[list(face)].sum(axis=0) - 3.0 * corners[i]
            s[:, 4 * i + 1 : 4 * i + 4] += c * alpha * s[:, f, None]
    return s[:, :16]


# --- transformation -----------------------------------------------------------------------------------------------


def transformation(corners: np.ndarray, slots: int = 20) -> np.ndarray:
    """T of S* = S T, which takes Cartesian to volume coordinates: e = T e*; (slots, slots), slots 20 (ENMC) or 16 (FN).

    The matrix itself is not in the appendix. Derived: r_(i -> j) = x_(j,i) r_x + y_(j,i) r_y + z_(j,i) r_z with the
    edge's components a, b, c of A.11; positions stay. det T = (6 V)^4.

    Args:
        corners: (4, 3) straight tetrahedron.
    """
    T = np.eye(slots)
    for i in range(4):
        T[4 * i + 1 : 4 * i + 4, 4 * i + 1 : 4 * i + 4] = corners[list(_others(i))] - corners[i]
    return T


def library_transformation(slots: int = 20) -> np.ndarray:
    """(slots, slots) L with tet_functions = S L: parent gradients are Cartesian ones on the unit tetrahedron."""
    return transformation(TET_CORNERS, slots)


# --- incomplete polynomials ---------------------------------------------------------------------------------------


def incomplete_basis(lam: np.ndarray) -> np.ndarray:
    """h_1 .. h_16 of A.14, a basis of FN's functions with c = 2/81: (Q, 4) -> (Q, 16)."""
    out = []
    for i in range(4):
        p, (q, r, s) = lam[:, i], (lam[:, n] for n in _others(i))
        out.append(p * (p**2 + 4.0 * (q * r + s * (q + r))))
    for i, j in PAIRS:
        p, q = lam[:, i], lam[:, j]
        out.append(p * q * (3.0 * p - sum(lam[:, n] for n in range(4) if n not in (i, j))))
    return np.stack(out, axis=1)


def fn_in_incomplete_basis() -> np.ndarray:
    """(16, 16) R of S = h R, FN's volume functions (c = 2/81) in the basis A.14, by least squares over all cubics.

    Not printed. In closed form s_i = h_i + sum over i's edges of h_(i -> j), and s_(i -> j) = h_(i -> j) / 3.
    """
    return np.linalg.lstsq(bezier_coefficients(incomplete_basis), bezier_coefficients(fn_volume), rcond=None)[0]


def power_basis(points: np.ndarray) -> np.ndarray:
    """b_1 .. b_20 of A.15, monomials of x, y, z: (Q, 3) -> (Q, 20)."""
    return np.prod(points[:, None, :] ** POWERS, axis=2)


@functools.cache
def _products() -> np.ndarray:
    """(4, 4, 4) place in A.15's order of the product of three terms, each one of 1, x, y, z."""
    place = {tuple(p): n for n, p in enumerate(POWERS.tolist())}
    entries = [place[t.count(1), t.count(2), t.count(3)] for t in itertools.product(range(4), repeat=3)]
    return np.array(entries).reshape(4, 4, 4)


def power_map(corners: np.ndarray) -> np.ndarray:
    """(20, 20) P of B = b P, Bernstein polynomials of a tetrahedron (4, 3) in monomials, by multiplying A.13 out."""
    forms = _linear_forms(corners)
    P = np.zeros((20, 20))
    for k, exponents in enumerate(LATTICE):
        u, v, w = forms[np.repeat(np.arange(4), exponents)]
        np.add.at(P[:, k], _products(), _MULTIPLICITY[k] * np.einsum("a,b,c->abc", u, v, w))
    return P


def incomplete_coefficients(corners: np.ndarray) -> np.ndarray:
    """(16, 20) a of A.15, h_i = sum_j a_(i,j) b_j, for a tetrahedron (4, 3); units length^-degree of each b_j.

    Not printed ("can be systematically defined"), and not A.11's a_(i,j), whose letter it shares: h re-expanded through
    Bernstein polynomials, which is better conditioned than a fit of monomials.
    """
    return (power_map(corners) @ bezier_coefficients(incomplete_basis)).T
