"""A chain of closed links that hangs from its first."""

import math

import numpy as np

import warpfea as wf
from warpfea.builder.scene import scene

FLATNESS = 0.9
"""Distance of the middle of a side of a link's section from its axis, over that of a corner."""


def link_mesh(length: float, width: float, wire: float, along: int, around: int) -> wf.mesh.Mesh:
    """A closed link in the x-z plane: T10 along two straight parts and two half circles.

    Args:
        length: of the axis from bend to bend, m.
        width: of the axis, twice the radius of a bend, m.
        wire: radius of the section, m, whose four sides are rounded.
        along: cells of a straight part.
        around: cells of a bend.
    """
    cells = 2 * (along + around)
    box = wf.mesh.box((cells, 2.0, 2.0), cells=(cells, 1, 1), origin=(0.0, -1.0, -1.0))
    radius, straight = 0.5 * width, length - width
    s = box.points[:, 0]
    half, way = np.divmod(s, along + around)
    angle = math.pi * np.clip((way - along) / around, 0.0, 1.0)
    up = straight * (np.clip(way / along, 0.0, 1.0) - 0.5)  # up on the right side, around the top, down on the left one
    axis = np.stack([radius * np.cos(angle), 0.0 * s, up + radius * np.sin(angle)], axis=1)
    outward = np.stack([np.cos(angle), 0.0 * s, np.sin(angle)], axis=1)
    u, v = box.points[:, 1], box.points[:, 2]
    size = np.where((u == 0.0) | (v == 0.0), FLATNESS, math.sqrt(0.5)) * wire
    sign = np.where(half % 2 == 0, 1.0, -1.0)[:, None]
    points = sign * (axis + (size * u)[:, None] * outward) + np.outer(size * v, (0.0, 1.0, 0.0))
    first = np.arange(len(points))
    end, start = np.flatnonzero(s == cells), np.flatnonzero(s == 0.0)  # the link is closed
    first[end] = start[np.argmin(np.linalg.norm(points[end, None] - points[start], axis=2), axis=1)]
    used, cells_of = np.unique(first[box.cells], return_inverse=True)
    return wf.mesh.check(wf.mesh.Mesh(points[used], cells_of.reshape(box.cells.shape), "tetra10", name="link"))


@scene(dt=4e-3, t_end=0.3, tol=1e-6, fps=60.0, speed=0.25, picture=0.29)
def links(
    *,
    count: int = 10,
    length: float = 0.06,
    width: float = 0.032,
    wire: float = 0.005,
    gap: float = 0.0002,
    along: int = 2,
    around: int = 4,
    mu: float = 0.0,
    E: float = 1e8,
    nu: float = 0.3,
    density: float = 1200.0,
) -> wf.ModelBuilder:
    """A chain of closed links, each turned by 90 degrees against the one above, falls into its first and hangs.

    Contact alone holds it together: each link bears the weight of those below.

    Args:
        count: number of links; the first is clamped at its upper bend.
        length: of a link's axis from bend to bend, m.
        width: of that axis, m.
        wire: radius of a link's section, m.
        gap: between links at the start, m.
        along: cells of a straight part of a link.
        around: cells of a bend.
        mu: coefficient of friction.
        E: Young's modulus (SVK), Pa.
        nu: Poisson's ratio.
        density: kg/m^3.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    mesh = link_mesh(length, width, wire, along, around)
    material = wf.SVK(E=E, nu=nu, density=density, damping=wf.KelvinVoigt(eta=1e-4 * E))
    pitch = length - 2.0 * FLATNESS * wire - gap
    turned = np.array([(0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
    links: list[wf.Body] = []
    for k in range(count):
        place = (turned if k % 2 else np.eye(3), np.array((0.0, 0.0, -k * pitch)))
        link = b.add_solid(mesh, material=material, transform=place, name=f"link {k + 1}")
        if not links:
            b.clamp(link.nodes(lambda X: X[:, 2] > 0.5 * (length - width) - 1e-9))
        else:
            b.add_contact(links[-1], link, mu=mu, name=f"joint {k}")
        links.append(link)
    b.add_probe("end", links[-1].at((0.0, 0.0, -(count - 1) * pitch - 0.5 * length)))
    return b
