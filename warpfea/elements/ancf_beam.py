"""ANCF beam 3243: two nodes, each with position and three gradients (Paper I, 1.3.1), and its remedies against locking.

On the parent xi in [0, 1], eta, zeta in [-1/2, 1/2] the basis [1, u, v, w, uv, uw, u^2, u^3] of Eq. (2) is: Hermite
cubics along the axis, linear in the section. Slot 1 is the gradient along the beam's axis, slots 2 and 3 are those
along width and height of the section; each node has its own axes.

Locking, and the remedies of the integrations:
- Poisson: a section that stays a parallelogram can't widen on one side and narrow on the other, so bending has the
  stiffness of uniaxial *strain*: 1.35 E for nu = 0.3. The part D0 of the SVK law without coupling of the normal
  strains is integrated over the volume, the Poisson part D - D0 on the axis alone (Gerstmayr, Matikainen, Mikkola
  2008, Multibody Syst. Dyn. 20:359); bending then has E, tension the full law.
- shear: section vectors turn linearly along an element, the slope of a cubic axis does not. Shear at the Gauss points
  makes both agree there, and the axis loses its cubic part. "tied" takes the transverse shear at the nodes, shared
  by neighbours. The deviation b of the axis from the sections in the middle of the element gets the energy of its
  curvature, missing in bending under a moment that varies linearly along the element (the residual
  bending flexibility of MacNeal 1978, Comput. Struct. 8:175).
- thickness: a section vector interpolated between two directions is too short in between; "tied" takes the strain in
  the section at the nodes (Betsch and Stein 1995, Commun. Numer. Methods Eng. 11:899).
- torsion and shear of a plane section (not locking, but too stiff as well): "tied" takes the section's own constants.
"tied" has all remedies, "split" the first at 3x2x2 points (as Project Chrono's 3243), "full" none (Paper I). Limits
of "tied": it passes the patch test under tension, not under shear tractions or pressure on its sides, which disturb
the gradients of the axis (to second order in h/t, or by a tenth of the strain in the section); and bending is too soft
by about 0.1 of the square of the angle that an element spans, as section vectors turn along a chord. Rejected:
curvature extrapolated from the middle and the ends, exact to fourth order in that angle, but with an error of 0.4
(h/R)^2 by exchange of stretch and curvature of the axis's gradient, not reduced by the mesh.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import ModelError
from ..materials import SVK, Material
from .ancf import to_node_axes
from .family import AssumedStrain, EnergyPart, Family, ParentDomain, VtkSubdivision, register
from .quadrature import Rule, box_rule, square_rule

if TYPE_CHECKING:
    from .sections import BeamSection

__all__ = ["BEAM", "parent_functions", "shear_law", "svk_only"]

LOW, HIGH = (0.0, -0.5, -0.5), (1.0, 0.5, 0.5)
_rule = functools.partial(box_rule, ranges=tuple(zip(LOW, HIGH)))


def parent_functions(xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Functions of (r, r_xi, r_eta, r_zeta) at both nodes and their parent derivatives: (Q, 8), (Q, 8, 3)."""
    x, y, z = xi.T
    one, zero = np.ones_like(x), np.zeros_like(x)
    H = [1 - 3 * x**2 + 2 * x**3, x - 2 * x**2 + x**3, 3 * x**2 - 2 * x**3, x**3 - x**2]
    dH = [6 * x**2 - 6 * x, 1 - 4 * x + 3 * x**2, 6 * x - 6 * x**2, 3 * x**2 - 2 * x]
    s, ds = [], []
    for n, (L, dL) in enumerate(((1 - x, -one), (x, one))):
        s += [H[2 * n], H[2 * n + 1], y * L, z * L]
        ds += [[dH[2 * n], zero, zero], [dH[2 * n + 1], zero, zero], [y * dL, L, zero], [z * dL, zero, L]]
    return np.stack(s, axis=1), np.moveaxis(np.array(ds), 2, 0)


def _shape_functions(xi: np.ndarray, nodes: np.ndarray, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return to_node_axes(*parent_functions(xi), frames)


def svk_only(material: Material) -> SVK:
    """The material as SVK, required by these integrations. Raises ModelError for any other."""
    if not isinstance(material, SVK):
        raise ModelError(f"this integration splits the St. Venant-Kirchhoff law, not {type(material).__name__}")
    return material


def orthotropic(coefficients: Callable[[SVK], tuple[float, ...]]) -> Callable[[Material], tuple[str, Any]]:
    """Law of a part of the energy with orthotropic coefficients: three normal moduli, three couplings, three shears."""
    return lambda material: ("orthotropic", coefficients(svk_only(material)))


UNCOUPLED_LAW = orthotropic(lambda m: (m.E, m.E, m.E, 0.0, 0.0, 0.0, m.lame[1], m.lame[1], m.lame[1]))
"""D0: Young's modulus in each direction without coupling, and the shear modulus."""
NORMAL_COUPLING_LAW = orthotropic(lambda m: (*[2.0 * m.nu * m.lame[0]] * 3, *[m.lame[0]] * 3, 0.0, 0.0, 0.0))
"""D - D0: the coupling of the normal strains."""
AXIAL_LAW = orthotropic(lambda m: (m.E, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
"""D0 along the axis."""
SECTION_LAW = orthotropic(lambda m: (0.0, m.E, m.E, 0.0, 0.0, 0.0, m.lame[1], 0.0, 0.0))
"""D0 in the section."""
SHEAR_OUTPUT_LAW = orthotropic(lambda m: (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, m.lame[1], m.lame[1]))
"""Transverse shears at quadrature points, for the stress output of "tied"."""


def box_faces(low: tuple[float, ...], high: tuple[float, ...]) -> tuple[np.ndarray, ...]:
    """Faces of a box in the order -x, +x, -y, +y, -z, +z: (4, 3) corners, outward, the first side along x if it can."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    return tuple(
        np.array(face)
        for face in (
            [(x0, y0, z0), (x0, y0, z1), (x0, y1, z1), (x0, y1, z0)],
            [(x1, y0, z0), (x1, y1, z0), (x1, y1, z1), (x1, y0, z1)],
            [(x0, y0, z0), (x1, y0, z0), (x1, y0, z1), (x0, y0, z1)],
            [(x1, y1, z0), (x0, y1, z0), (x0, y1, z1), (x1, y1, z1)],
            [(x1, y0, z0), (x0, y0, z0), (x0, y1, z0), (x1, y1, z0)],
            [(x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)],
        )
    )


def box_subdivision(low: tuple[float, ...], high: tuple[float, ...], parts: tuple[int, int, int]) -> VtkSubdivision:
    """A box cut into parts[0] x parts[1] x parts[2] hexahedra, for drawing."""
    axes = [np.linspace(a, b, n + 1) for a, b, n in zip(low, high, parts)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    k = np.arange(len(points)).reshape([n + 1 for n in parts])
    corner = [k[:-1, :-1, :-1], k[1:, :-1, :-1], k[1:, 1:, :-1], k[:-1, 1:, :-1]]
    corner += [k[:-1, :-1, 1:], k[1:, :-1, 1:], k[1:, 1:, 1:], k[:-1, 1:, 1:]]
    return VtkSubdivision(points, "hexahedron", np.stack(corner, axis=-1).reshape(-1, 8))


# (eta, zeta) in the section
SECTION_CORNERS = [(y, z) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
SECTION_GAUSS_POINTS = [(y, z) for y in (-0.5 / 3**0.5, 0.5 / 3**0.5) for z in (-0.5 / 3**0.5, 0.5 / 3**0.5)]


def shear_law(material: Material) -> tuple[str, tuple[float, ...]]:
    """Transverse shear at tying points."""
    return "assumed_strain", (svk_only(material).lame[1],)


def _shear_coupling(
    at: np.ndarray, J: np.ndarray, det: np.ndarray, rule: Rule, material: Material, section: BeamSection
) -> np.ndarray:
    """A (E, 24, 12) with e.A e / 2 = V/2 times the sum of k (g_0^2 + g_1^2)/2 + (c/mu) b^2, over directions and modes.

    The shear angles are g = e/(|X_a| |X_b|) at the ends (0, 1) and in the middle (m), and b = g_m - (g_0 + g_1)/2.
    Modes of the four points of a section: the mean with the section's shear factor k; the one that is odd across the
    direction, torsion, with k = J_t/I_p; the two others with k = 1. With c = (4/9) E t^2/h^2, where t is the height
    and h the length, c b^2 V/2 is the energy of a curvature that varies linearly along the element.
    """
    m = svk_only(material)
    size = np.linalg.norm(at, axis=2)
    a, b = SHEAR_TYING.pairs.T
    t = np.arange(len(a))
    scale = 1.0 / (size[:, t, a] * size[:, t, b])
    volume = det @ rule.weights
    length = size[:, :, 0].mean(axis=1)
    gauss = np.array(SECTION_GAUSS_POINTS)
    modes = np.array([np.ones(4), *np.sign(gauss.T), np.sign(np.prod(gauss, axis=1))]) / 4.0
    ends, deviation = 0.5 * np.diag([1.0, 0.0, 1.0]), np.array([-0.5, 1.0, -0.5])
    torsion = section.torsion_ratio_at(*(size[:, 12 * k : 12 * k + 12, 1 + k].mean(axis=1) for k in (0, 1)))
    out = np.empty((len(at), len(a), 12), dtype=np.result_type(m.E / m.lame[1]))  # complex for derivatives by nu
    for direction in (0, 1):
        rows = slice(12 * direction, 12 * direction + 12)
        height = size[:, rows, 1 + direction].mean(axis=1)
        c = 4.0 / 9.0 * (m.E / m.lame[1]) * (height / length) ** 2
        plain = np.zeros((12, 12))
        for k, mode in enumerate(modes):
            factor = {0: section.shear, 2 - direction: torsion}.get(k, 1.0)
            plain = plain + np.multiply.outer(factor, np.kron(np.outer(mode, mode), ends))
        bent = np.kron(np.eye(4) / 4.0, np.outer(deviation, deviation))
        block = plain + c[:, None, None] * bent
        out[:, rows] = volume[:, None, None] * scale[:, rows, None] * scale[:, None, rows] * block
    return out


SHEAR_TYING_POINTS = [(x, y, z) for y, z in SECTION_GAUSS_POINTS for x in (0.0, 0.5, 1.0)]
SHEAR_TYING = AssumedStrain(
    np.array(2 * SHEAR_TYING_POINTS),
    np.repeat([(0, 1), (0, 2)], 12, axis=0),
    _shear_coupling,
    width=12,
    material_constants=("nu",),
)


def end_point_rule(rule: Rule) -> Rule:
    """A rule of two points along the axis with the points moved to the ends of the element (trapezoidal rule)."""
    points = rule.points.copy()
    points[:, 0] = np.round(points[:, 0])
    return Rule(f"ends {rule.name}", points, rule.weights, 1, rule.counts)


BEAM = register(
    Family(
        name="3243",
        cell_type="line",
        node_slots=((0, 1, 2, 3),) * 2,
        shape=_shape_functions,
        rules={"full": _rule((5, 3, 3)), "3x2x2": _rule((3, 2, 2))},
        curved_rule=_rule((5, 3, 3)),
        mass_rule=_rule((4, 2, 2)),
        # degree 14 along a curved axis: two cubics, and det J0 of degree 8
        curved_mass_rule=_rule((8, 4, 4)),
        vertices=np.array([(0.0, -0.5, -0.5), (0.0, 0.5, 0.5), (1.0, -0.5, 0.5), (1.0, 0.5, -0.5)]),
        parent=ParentDomain(LOW, HIGH),
        faces=box_faces(LOW, HIGH),
        face_names=("start", "end", "side-", "side+", "normal-", "normal+"),
        face_rule=square_rule(5),
        face_divisions=((2, 2), (2, 2), (6, 2), (6, 2), (6, 2), (6, 2)),
        node_samples=np.array([[(x, y, z) for y, z in SECTION_CORNERS] for x in (0.0, 1.0)]),
        vtk_subdivision=box_subdivision(LOW, HIGH, (4, 1, 1)),
        schemes={
            "tied": (
                EnergyPart("axis", _rule((3, 2, 2)), AXIAL_LAW, framed=True),
                EnergyPart("section", end_point_rule(_rule((2, 2, 2))), SECTION_LAW, framed=True),
                EnergyPart("D_nu", end_point_rule(_rule((2, 1, 1))), NORMAL_COUPLING_LAW, framed=True),
                EnergyPart("shear", _rule((3, 2, 2)), shear_law, tying=SHEAR_TYING),
            ),
            "split": (
                EnergyPart("D0", _rule((3, 2, 2)), UNCOUPLED_LAW, framed=True),
                EnergyPart("D_nu", _rule((3, 1, 1)), NORMAL_COUPLING_LAW, framed=True),
            ),
        },
        output_schemes={"shear stress": (EnergyPart("shear", _rule((3, 2, 2)), SHEAR_OUTPUT_LAW, framed=True),)},
        slot_sets={"axis": (1,), "section": (2, 3)},
        spin_vectors=2,
        solid=False,
    )
)
