"""Quadrature on the unit tetrahedron and triangle and on boxes; weights sum to the volume or area of the parent."""

import functools
from dataclasses import dataclass

import numpy as np
from scipy.special import roots_jacobi

from ..mesh.cells import CENTROID, TET14_ORBITS, edge_orbit, vertex_orbit

__all__ = [
    "TET_RULES", "Rule", "box_rule", "composite_rule", "conical_tet", "conical_triangle", "lobatto_square",
    "square_rule", "trapezoidal_rule", "triangle_3", "triangle_6", "triangle_7", "triangle_16",
]  # fmt: skip


@dataclass(frozen=True, eq=False)
class Rule:
    """A quadrature rule.

    Attributes:
        name: selector.
        points: (Q, 3) or (Q, 2) parent coordinates.
        weights: (Q,), with sum equal to the parent's volume or area.
        degree: total degree of the polynomials integrated exactly.
        counts: points along each direction of a product rule on a box (all points in "ij" order), else empty.
    """

    name: str
    points: np.ndarray
    weights: np.ndarray
    degree: int
    counts: tuple[int, ...] = ()

    @property
    def points_on_medians(self) -> bool:
        """True if a tetrahedron's rule has a point on each line from the centroid to vertices 0-3, in this order.

        The centroid may precede them.
        """
        if self.points.shape not in ((4, 3), (5, 3)):
            return False
        own = np.column_stack([1.0 - self.points.sum(axis=1), self.points])
        near = own[-4, 0] - own[-4, 1]
        towards = 0.25 + near * (np.eye(4) - 0.25)
        return bool(near != 0.0 and np.allclose(own[-4:], towards, 0, 1e-14) and np.allclose(own[:-4], 0.25, 0, 1e-14))


def _rule_from_orbits(name: str, degree: int, *orbits: tuple[float, np.ndarray]) -> Rule:
    """Rule on the tetrahedron from orbits (weight of a point over the volume, points (n, 3))."""
    weights = np.concatenate([np.full(len(points), w / 6.0) for w, points in orbits])
    return Rule(name, np.concatenate([points for _, points in orbits]), weights, degree)


_VERTICES, _OTHERS, _EDGES = TET14_ORBITS
TET_RULES: dict[str, Rule] = {rule.name: rule for rule in (
    Rule("tet1", CENTROID, np.array([1.0 / 6.0]), 1),
    _rule_from_orbits("tet4", 2, (0.25, vertex_orbit((5.0 - np.sqrt(5.0)) / 20.0))),
    # Paper I's rule, Eq. (11); its negative weight makes the T10 mass matrix indefinite
    _rule_from_orbits("tet5_paper", 3, (-0.8, CENTROID), (0.45, vertex_orbit(1.0 / 6.0))),
    # positive weights, interior points (Jaskowiec and Sukumar, symmetric tetrahedron rules, 2020)
    _rule_from_orbits("tet8", 3, (0.1385279665118621, vertex_orbit(0.3280546967114266)),
                      (0.1114720334881379, vertex_orbit(0.1069522739329306))),
    # positive weights (J. N. Walkington, quadrature on simplices, 2000)
    _rule_from_orbits("tet14", 5, (6 * 0.01878132095300264180, vertex_orbit(_VERTICES)),
                      (6 * 0.01224884051939365826, vertex_orbit(_OTHERS)),
                      (6 * 0.0070910034628469110730, edge_orbit(_EDGES))),
)}  # fmt: skip


def _gauss_jacobi(n: int, alpha: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Jacobi points and weights (n,) on [0, 1] for the weight function (1 - x)^alpha."""
    x, w = roots_jacobi(n, alpha, 0)
    return (1.0 + x) / 2.0, w / 2.0 ** (alpha + 1)


@functools.cache
def conical_tet(n: int) -> Rule:
    """Conical product rule (Stroud 1971): n^3 points, positive weights, degree 2n - 1."""
    (a, wa), (b, wb), (c, wc) = _gauss_jacobi(n, 2), _gauss_jacobi(n, 1), _gauss_jacobi(n, 0)
    A, B, C = np.meshgrid(a, b, c, indexing="ij")
    points = np.stack([A, B * (1 - A), C * (1 - A) * (1 - B)], axis=-1).reshape(-1, 3)
    weights = np.einsum("i,j,k->ijk", wa, wb, wc).ravel()
    return Rule(f"conical{n}", points, weights, 2 * n - 1)


@functools.cache
def conical_triangle(n: int) -> Rule:
    """Conical product rule on the triangle: n^2 points, positive weights, degree 2n - 1."""
    (a, wa), (b, wb) = _gauss_jacobi(n, 1), _gauss_jacobi(n, 0)
    A, B = np.meshgrid(a, b, indexing="ij")
    points = np.stack([A, B * (1 - A)], axis=-1).reshape(-1, 2)
    return Rule(f"conical_triangle{n}", points, np.einsum("i,j->ij", wa, wb).ravel(), 2 * n - 1)


@functools.cache
def triangle_6() -> Rule:
    """Six points, degree 4, positive weights (Dunavant 1985): pressure on a quadratic face needs degree 4."""
    rows = []
    for a, w in ((0.445948490915965, 0.223381589678011), (0.091576213509771, 0.109951743655322)):
        for p in ((a, a), (a, 1 - 2 * a), (1 - 2 * a, a)):
            rows.append((*p, w / 2.0))
    table = np.array(rows)
    return Rule("triangle6", table[:, :2], table[:, 2], 4)


@functools.cache
def triangle_3() -> Rule:
    """The three vertices, degree 1."""
    return Rule("triangle3", np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)]), np.full(3, 1.0 / 6.0), 1)


@functools.cache
def triangle_7() -> Rule:
    """Vertices, mid-sides and centre, degree 3, positive weights (Stroud 1971); contact needs corners."""
    corners, middles = [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)], [(0.5, 0.0), (0.5, 0.5), (0.0, 0.5)]
    points = np.array([*corners, *middles, (1.0 / 3.0, 1.0 / 3.0)])
    return Rule("triangle7", points, np.repeat([1.0 / 40.0, 1.0 / 15.0, 9.0 / 40.0], [3, 3, 1]), 3)


@functools.cache
def triangle_16() -> Rule:
    """Vertices, two points on each side, six inside and the centre: degree 7 with positive weights.

    Solution of the eight moment equations of an orbit of vertices, one of six points on the sides, two of three
    interior points and the centre; contact between non-matching meshes needs corners and many points.
    """
    side, near, far = 0.160700827727076, 0.1549360602237603, 0.46915074614381225
    points = [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)]
    for t in (side, 1.0 - side):
        points += [(t, 0.0), (1.0 - t, t), (0.0, 1.0 - t)]
    for t in (near, far):
        points += [(t, t), (1.0 - 2.0 * t, t), (t, 1.0 - 2.0 * t)]
    points.append((1.0 / 3.0, 1.0 / 3.0))
    weights = (0.0040363384425610134, 0.023685036309926584, 0.11665205858990337, 0.1065039918141737,
               0.17631261560052625)  # fmt: skip
    return Rule("triangle16", np.array(points), 0.5 * np.repeat(weights, [3, 6, 3, 3, 1]), 7)


Ranges = tuple[tuple[float, float], ...]


def _gauss_product_rule(name: str, counts: tuple[int, ...], ranges: Ranges) -> Rule:
    points, weights = [], []
    for n, (low, high) in zip(counts, ranges):
        x, w = np.polynomial.legendre.leggauss(n)
        points.append(0.5 * (high - low) * x + 0.5 * (high + low))
        weights.append(0.5 * (high - low) * w)
    grid = np.stack(np.meshgrid(*points, indexing="ij"), axis=-1).reshape(-1, len(counts))
    product = weights[0]
    for w in weights[1:]:
        product = np.multiply.outer(product, w)
    return Rule(name, grid, product.ravel(), 2 * min(counts) - 1, counts)


@functools.cache
def box_rule(counts: tuple[int, int, int], ranges: Ranges) -> Rule:
    """Product Gauss rule on a box, named e.g. "3x2x2"; a single point lies in the middle, its weight is the length."""
    return _gauss_product_rule("x".join(map(str, counts)), counts, ranges)


@functools.cache
def square_rule(n: int) -> Rule:
    """Product Gauss rule of n^2 points on the unit square."""
    return _gauss_product_rule(f"square{n}", (n, n), ((0.0, 1.0), (0.0, 1.0)))


@functools.cache
def lobatto_square(n: int) -> Rule:
    """Product Gauss-Lobatto rule of n^2 points on the unit square, n >= 2, with its corners; degree 2n - 3."""
    last = np.polynomial.legendre.Legendre.basis(n - 1)
    x = np.concatenate([[-1.0], np.sort(last.deriv().roots().real), [1.0]])
    w = 2.0 / (n * (n - 1) * last(x) ** 2)
    x, w = 0.5 * (1.0 + x), 0.5 * w
    grid = np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1).reshape(-1, 2)
    return Rule(f"lobatto{n}", grid, np.outer(w, w).ravel(), 2 * n - 3, (n, n))


def composite_rule(rule: Rule, parts: int) -> Rule:
    """Composite rule: a rule on the unit square or triangle on parts x parts equal parts, for integrands with kinks."""
    if parts == 1:
        return rule
    cells = [(np.array([i, j]), 1.0) for i in range(parts) for j in range(parts)]
    if rule.weights.sum() < 0.75:  # triangle: upright parts, and inverted ones between them
        cells = [(np.array([i, j]), 1.0) for i in range(parts) for j in range(parts - i)]
        cells += [(np.array([i + 1, j + 1]), -1.0) for i in range(parts - 1) for j in range(parts - 1 - i)]
    points = np.concatenate([(corner + sign * rule.points) / parts for corner, sign in cells])
    return Rule(f"{rule.name}/{parts}", points, np.tile(rule.weights, len(cells)) / parts**2, rule.degree)


def trapezoidal_rule(corners: int, parts: tuple[int, int]) -> Rule:
    """Trapezoidal rule on parts[0] x parts[1] equal parts of the unit square, or on as many, the larger number, along
    all sides of the unit triangle; of degree 1, with equidistant points, those on the sides included."""
    a, b = parts if corners == 4 else (max(parts), max(parts))
    i, j = (index.ravel() for index in np.meshgrid(np.arange(a + 1), np.arange(b + 1), indexing="ij"))
    inside = [1.0 * (i > 0) + (i < a), 1.0 * (j > 0) + (j < b)]
    weights = 0.25 * inside[0] * inside[1] / (a * b)
    if corners == 3:
        i, j = i[i + j <= a], j[i + j <= a]
        on_sides = 1 * (i == 0) + (j == 0) + (i + j == a)
        weights = np.array([6.0, 3.0, 1.0])[on_sides] / (6.0 * a * a)
    return Rule(f"trapezoidal{a}x{b}", np.stack([i / a, j / b], axis=1), weights, 1)
