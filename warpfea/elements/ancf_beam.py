"""ANCF beam 3243: two nodes, each with position and three gradients (Paper I, 1.3.1), and the split against locking.

On the parent xi in [0, 1], eta, zeta in [-1/2, 1/2] the basis [1, u, v, w, uv, uw, u^2, u^3] of Eq. (2) is: Hermite
cubics along the axis, linear in the section. Slot 1 is the gradient along the beam's axis, 2 and 3 lie in the section
(width, height); the axes are each node's own.

A section that stays a parallelogram can't widen on one side and narrow on the other, so bending meets the stiffness
of uniaxial *strain*: with nu = 0.3, 1.35 E. "split" (Gerstmayr, Matikainen, Mikkola 2008, Multibody Syst. Dyn. 20:359)
integrates the part D0 of the SVK law that couples nothing over the volume, and the Poisson part D - D0 on the axis
alone; bending then has E, tension the full law. "full" is Paper I's.
"""

from __future__ import annotations

import numpy as np

from ..errors import ModelError
from ..materials import SVK, Material
from .ancf import fold
from .family import Family, Lattice, Parent, Part, register
from .quadrature import box_rule, square_rule

__all__ = ["BEAM", "parent_functions", "svk_only"]

LOW, HIGH = (0.0, -0.5, -0.5), (1.0, 0.5, 0.5)
RANGES = tuple(zip(LOW, HIGH))


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


def _shape(xi: np.ndarray, nodes: np.ndarray, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return fold(*parent_functions(xi), frames)


def svk_only(material: Material) -> SVK:
    """The split is of the SVK law."""
    if not isinstance(material, SVK):
        raise ModelError(
            "integration='split' splits the St. Venant-Kirchhoff law; use integration='full' with "
            f"{type(material).__name__}"
        )
    return material


def _poisson_free(material: Material) -> tuple[str, tuple[float, ...]]:
    """D0: E in each direction without coupling, and the shear modulus."""
    m = svk_only(material)
    _, mu = m.lame
    return "orthotropic", (m.E, m.E, m.E, 0.0, 0.0, 0.0, mu, mu, mu)


def _poisson_part(material: Material) -> tuple[str, tuple[float, ...]]:
    """D - D0: what couples the normal strains."""
    m = svk_only(material)
    lam, _ = m.lame
    d = 2.0 * m.nu * lam
    return "orthotropic", (d, d, d, lam, lam, lam, 0.0, 0.0, 0.0)


def box_corners(low: tuple[float, ...], high: tuple[float, ...]) -> tuple[np.ndarray, ...]:
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


def box_lattice(low: tuple[float, ...], high: tuple[float, ...], parts: tuple[int, int, int]) -> Lattice:
    """A box cut into hexahedra."""
    axes = [np.linspace(a, b, n + 1) for a, b, n in zip(low, high, parts)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    k = np.arange(len(points)).reshape([n + 1 for n in parts])
    corner = [k[:-1, :-1, :-1], k[1:, :-1, :-1], k[1:, 1:, :-1], k[:-1, 1:, :-1]]
    corner += [k[:-1, :-1, 1:], k[1:, :-1, 1:], k[1:, 1:, 1:], k[:-1, 1:, 1:]]
    return Lattice(points, "hexahedron", np.stack(corner, axis=-1).reshape(-1, 8))


SECTION = [(y, z) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]

BEAM = register(
    Family(
        name="3243",
        cell_type="line",
        node_slots=((0, 1, 2, 3),) * 2,
        shape=_shape,
        rules={"full": box_rule((5, 3, 3), RANGES), "3x2x2": box_rule((3, 2, 2), RANGES)},
        curved_rule=box_rule((5, 3, 3), RANGES),
        mass_rule=box_rule((4, 2, 2), RANGES),
        # degree 14 along a curved axis: two cubics, and det J0 of degree 8
        curved_mass_rule=box_rule((8, 4, 4), RANGES),
        vertices=np.array([(0.0, -0.5, -0.5), (0.0, 0.5, 0.5), (1.0, -0.5, 0.5), (1.0, 0.5, -0.5)]),
        affine=False,
        parent=Parent(LOW, HIGH),
        faces=box_corners(LOW, HIGH),
        face_rule=square_rule(5),
        divisions=((1, 1), (1, 1), (6, 1), (6, 1), (6, 1), (6, 1)),
        node_samples=np.array([[(x, y, z) for y, z in SECTION] for x in (0.0, 1.0)]),
        lattice=box_lattice(LOW, HIGH, (4, 1, 1)),
        schemes={
            "split": (
                Part("D0", box_rule((3, 2, 2), RANGES), _poisson_free, framed=True),
                Part("D_nu", box_rule((3, 1, 1), RANGES), _poisson_part, framed=True),
            ),
        },
        slot_sets={"axis": (1,), "section": (2, 3)},
        spin_vectors=2,
        solid=False,
    )
)
