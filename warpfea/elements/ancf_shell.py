"""ANCF shell 3443: four nodes, each with position and three gradients (Paper I, 1.3.2), and remedies against locking.

On the parent xi, eta in [0, 1] (mid-surface) and zeta in [-1/2, 1/2] (thickness) the basis is that of Eq. (3) with
u = xi, w = eta and v = zeta: twelve functions of the mid-surface, and functions bilinear in the surface times the
thickness. Slots 1 and 2 are gradients along the surface, slot 3 along the director; with bases on the parent square,
shared nodes make the surface continuous also on distorted quads.

Locking and its remedies, by the choice of strains and integration points ("tied"):
- Poisson (thickness): a director that is one vector per point can't strain linearly through the thickness, so bending
  is (1-nu)^2/(1-2nu) times too stiff (1.225 for nu = 0.3). The law is split into plane stress, integrated through the
  thickness, which needs no such strain, and the part that couples the thickness to the surface, integrated on the
  mid-surface alone (the split of Gerstmayr, Matikainen, Mikkola 2008 for beams, taken to shells).
- shear: the bilinear director can't follow the slopes of the cubic surface, so a thin plate would have to bend with
  constant curvature in each direction: it locks (a clamped 8x8 plate of t/L = 1e-3 deflects 3 % of the exact value,
  with 3x3 points as with 4x4). The covariant transverse shears are taken at the corners and the middles of the edges
  they run along, shared by neighbours, and interpolated (assumed natural strain, Dvorkin and Bathe 1984, Eng. Comput.
  1:77; here quadratically along the edges, as the slopes of their Hermite cubics): two conditions per node and one
  per edge remain, fewer than unknowns. Reissner's factor 5/6 accounts for the shear stress vanishing at the faces.
- curvature thickness: a director interpolated between two directions is too short in between; on a curved or
  strongly bent shell the spurious strain energy exceeds that of bending (a thin quarter arc of 16 elements bends
  0.13 of the exact value). The strain
  across the thickness is taken at the nodes and interpolated (Betsch and Stein 1995, Commun. Numer. Methods Eng.
  11:899). The strains in the surface that it is coupled to are taken at 2x2 points, which integrate their variations on
  any flat quad; at the nodes alone they do not balance those of plane stress, and the pressure of a pressed plate on
  a flat collider varies by 1e-3. Means of the surface gradients at the nodes, in place of strains at
  points, lock a thin arc (0.83 of the deflection with 16 elements, 0.37 with 8). Strains averaged to the nodes do not,
  but make the surface stiffer (Cook's membrane, nu = 0.49, 4x4 elements: by 6 %).
- membrane: needs no remedy. The cubic surface follows an arc without stretching to fourth order in its angle; with the
  thickness strain out of the way a thin arc (R/t = 1000) bends as a thick one does: plane stress stays at 4x4 points.
"full" is Paper I's law at 4x4x2 points, without remedies. Limits of "tied": it passes the patch test under plane
stress and a pressure on both faces on any mesh, and under uniform transverse shear on parallelograms; on general quads
that is off by a few percent of the shear. "full" passes all of these.
"""

import functools

import numpy as np

from ..materials import Material
from .ancf import nodal_shape_functions
from .ancf_beam import box_faces, box_subdivision, shear_law, svk_only
from .family import AssumedStrain, EnergyPart, Family, ParentDomain, register
from .quadrature import Rule, box_rule, square_rule

__all__ = ["SHELL", "SHELL_EXPONENTS"]

# exponents of (xi, eta, zeta) in Paper I's order with u = xi, w = eta, v = zeta
SHELL_EXPONENTS = np.array(
    [(0, 0, 0), (1, 0, 0), (0, 0, 1), (0, 1, 0), (1, 1, 0), (0, 1, 1), (1, 0, 1), (2, 0, 0), (0, 2, 0), (3, 0, 0)]
    + [(0, 3, 0), (2, 1, 0), (1, 2, 0), (1, 1, 1), (3, 1, 0), (1, 3, 0)]
)
SHELL_NODES = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0), (0.0, 1.0, 0.0)])
LOW, HIGH = (0.0, 0.0, -0.5), (1.0, 1.0, 0.5)
_rule = functools.partial(box_rule, ranges=tuple(zip(LOW, HIGH)))


def _plane_stress_law(material: Material) -> tuple[str, tuple[float, ...]]:
    """Part integrated through the thickness: plane stress, without thickness strain and transverse shear."""
    m = svk_only(material)
    _, mu = m.lame
    c = m.E / (1.0 - m.nu * m.nu)
    return "orthotropic", (c, c, 0.0, 0.0, 0.0, m.nu * c, 0.0, 0.0, mu)


def _thickness_law(material: Material) -> tuple[str, tuple[float, ...]]:
    """Remainder, (d/2) (E_33 + k (E_11 + E_22))^2 with d = lambda + 2 mu and k = nu/(1 - nu): 0 in plane stress."""
    lam, mu = svk_only(material).lame
    return "assumed_strain", (lam + 2.0 * mu,)


def _thickness_output_law(material: Material) -> tuple[str, tuple[float, ...]]:
    """Law of `_thickness_law` at points, for stress output."""
    m = svk_only(material)
    lam, mu = m.lame
    c = m.E / (1.0 - m.nu * m.nu)
    d = lam + 2.0 * mu
    return "orthotropic", (d - c, d - c, d, lam, lam, lam - m.nu * c, 0.0, 0.0, 0.0)


def _tying_weights(xi: np.ndarray) -> np.ndarray:
    """(Q, 12) interpolation from the tying points: quadratic along a shear's own direction, linear across it."""

    def linear_basis(x: np.ndarray) -> list[np.ndarray]:
        return [1.0 - x, x]

    def quadratic_basis(x: np.ndarray) -> list[np.ndarray]:
        return [(1.0 - x) * (1.0 - 2.0 * x), 4.0 * x * (1.0 - x), x * (2.0 * x - 1.0)]

    x, y = xi[:, 0], xi[:, 1]
    first = [a * b for b in linear_basis(y) for a in quadratic_basis(x)]
    second = [a * b for a in linear_basis(x) for b in quadratic_basis(y)]
    return np.stack(first + second, axis=1)


def _corner_weights(xi: np.ndarray) -> np.ndarray:
    """(Q, 4) bilinear interpolation from the corners, in the order of `CORNER_RULE`."""
    x, y = xi[:, 0], xi[:, 1]
    return np.stack([(1.0 - x) * (1.0 - y), (1.0 - x) * y, x * (1.0 - y), x * y], axis=1)


def _shear_coupling(
    at: np.ndarray, J: np.ndarray, det: np.ndarray, rule: Rule, material: Material, section: object
) -> np.ndarray:
    """A (E, 12, 12) of (mu/2) e.A e = (5/6) (mu/2) int e_a e_b (g^ab g^33 + g^a3 g^b3) dV, with e interpolated."""
    g = np.linalg.inv(np.swapaxes(J, 2, 3) @ J)
    metric = g[:, :, :2, :2] * g[:, :, 2, 2][:, :, None, None] + g[:, :, :2, 2, None] * g[:, :, None, :2, 2]
    D = SHEAR_TYING.pairs[:, 0]
    N = _tying_weights(rule.points)
    w = 5.0 / 6.0 * det * rule.weights
    return np.einsum("eq,qs,qt,eqst->est", w, N, N, metric[:, :, D[:, None], D[None, :]], optimize=True)


def _thickness_coupling(
    at: np.ndarray, J: np.ndarray, det: np.ndarray, rule: Rule, material: Material, section: object
) -> np.ndarray:
    """A (E, 12, 12) of (d/2) e.A e = (d/2) int (E_33 + k (E_11 + E_22))^2 dV, E_33 bilinear from the nodes."""
    nu = svk_only(material).nu
    own = np.kron(np.eye(len(rule.weights)), np.full(2, nu / (1.0 - nu)))
    theta = 0.5 * np.hstack([_corner_weights(rule.points), own])
    return np.einsum("eq,qs,qt->est", det * rule.weights, theta, theta)


SHEAR_TYING = AssumedStrain(
    points=np.array(
        [(x, y, 0.0) for y in (0.0, 1.0) for x in (0.0, 0.5, 1.0)]
        + [(x, y, 0.0) for x in (0.0, 1.0) for y in (0.0, 0.5, 1.0)]
    ),
    pairs=np.repeat([(0, 2), (1, 2)], 6, axis=0),
    coupling=_shear_coupling,
    width=12,
)

CORNER_RULE = Rule("corners", SHELL_NODES[[0, 3, 1, 2]], np.full(4, 0.25), 1, (2, 2, 1))
SURFACE_RULE = _rule((2, 2, 1))  # exact for the derivatives of the cubic functions over any flat quad
THICKNESS_TYING = AssumedStrain(
    points=np.vstack([CORNER_RULE.points, np.repeat(SURFACE_RULE.points, 2, axis=0)]),
    pairs=np.array([(2, 2)] * 4 + [(0, 0), (1, 1)] * 4),
    coupling=_thickness_coupling,
    width=12,
    material_constants=("nu",),
)
_BOX_FACES = box_faces(LOW, HIGH)

SHELL = register(
    Family(
        name="3443",
        cell_type="quad",
        node_slots=((0, 1, 2, 3),) * 4,
        shape=nodal_shape_functions(SHELL_EXPONENTS, SHELL_NODES),
        rules={"full": _rule((4, 4, 2))},
        curved_rule=_rule((4, 4, 2)),
        mass_rule=_rule((4, 4, 2)),
        curved_mass_rule=_rule((8, 8, 3)),
        vertices=SHELL_NODES,
        parent=ParentDomain(LOW, HIGH),
        # bottom, top, then the strips over the edges 01, 12, 23, 30 of the quad
        faces=(_BOX_FACES[4], _BOX_FACES[5], _BOX_FACES[2], _BOX_FACES[1], _BOX_FACES[3], _BOX_FACES[0]),
        face_rule=square_rule(5),
        face_divisions=((3, 3), (3, 3), (3, 2), (3, 2), (3, 2), (2, 3)),
        node_samples=SHELL_NODES[:, None] + np.array([(0.0, 0.0, -0.5), (0.0, 0.0, 0.5)]),
        vtk_subdivision=box_subdivision(LOW, HIGH, (2, 2, 1)),
        schemes={
            "tied": (
                EnergyPart("surface", _rule((4, 4, 2)), _plane_stress_law, framed=True),
                EnergyPart("thickness", SURFACE_RULE, _thickness_law, framed=True, tying=THICKNESS_TYING),
                EnergyPart("shear", _rule((4, 4, 2)), shear_law, tying=SHEAR_TYING),
            )
        },
        output_schemes={
            "thickness stress": (EnergyPart("thickness", CORNER_RULE, _thickness_output_law, framed=True),)
        },
        slot_sets={"surface": (1, 2), "director": (3,)},
        spin_vectors=1,
        solid=False,
    )
)
