"""A pile of bodies of all families in a box."""

import numpy as np

import warpfea as wf
from warpfea.builder.scene import scene

FAMILIES = ("T4", "T10", "ENMC", "H3843", "3243", "3443")


@scene(dt=5e-3, t_end=5.0, tol=1e-6, fps=60.0, speed=0.5, picture=4.9)
def pile(
    *,
    count: int = 30,
    size: float = 0.1,
    across: int = 3,
    mu: float = 0.3,
    E: float = 1e6,
    nu: float = 0.3,
    density: float = 1000.0,
    seed: int = 1,
) -> wf.ModelBuilder:
    """Soft bodies of six families, turned by chance, fall into a box on each other and come to rest.

    In turn they are a cube of T4, a ball of T10, a cube of ENMC, a block of H3843, a beam 3243 and a shell 3443.

    Args:
        count: bodies.
        size: of a body, m.
        across: bodies side by side in the box, along both edges of a layer.
        mu: coefficient of friction.
        E: Young's modulus (neo-Hookean, with viscosity), Pa.
        nu: Poisson's ratio.
        density: kg/m^3.
        seed: of the angles.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    damping = wf.KelvinVoigt(eta=0.2 * size * np.sqrt(E * density))
    material = wf.NeoHookean.from_E_nu(E=E, nu=nu, density=density, damping=damping)
    chance = np.random.default_rng(seed)
    step = 1.45 * size
    for k in range(count):
        family = FAMILIES[k % len(FAMILIES)]
        layer, place = divmod(k, across * across)
        at = np.array([place % across + 0.5, place // across + 0.5, layer + 0.5]) * step
        axes = np.linalg.qr(chance.normal(size=(3, 3)))[0]
        axes[:, 0] *= np.linalg.det(axes)
        add_body(b, family, size, at, axes, material, f"{family} {k + 1}")
    width = across * step
    b.add_collider(wf.HalfSpace((0, 0, 1)), name="floor")
    for axis in (0, 1):
        normal = np.eye(3)[axis]
        b.add_collider(wf.HalfSpace(normal), name=f"{'xy'[axis]}-")
        b.add_collider(wf.HalfSpace(-normal, -width), name=f"{'xy'[axis]}+")
    b.add_contact_all(mu=mu)
    return b


def add_body(b, family, size, at, axes, material, name):
    """A body of a family about a point, with these axes; a probe at its middle."""
    if family == "3243":
        ends = [at - 0.6 * size * axes[:, 0], at + 0.6 * size * axes[:, 0]]
        section = wf.Rectangle(0.2 * size, 0.2 * size)
        body = b.add_beam(ends, elements=4, section=section, normal=axes[:, 2], material=material, name=name)
    elif family == "3443":
        mesh = wf.mesh.grid((size, size), cells=(2, 2), origin=(-0.5 * size,) * 2 + (0.0,))
        body = b.add_shell(turned(mesh, at, axes), thickness=0.15 * size, material=material, name=name)
    elif family == "T10":
        body = b.add_solid(wf.mesh.sphere(0.4 * size, cells=2, center=tuple(at)), material=material, name=name)
    else:
        edges = (0.8 * size,) * 3 if family != "H3843" else (size, 0.7 * size, 0.4 * size)
        cells = (2, 2, 2) if family == "T4" else (1, 1, 1)
        mesh = wf.mesh.box(edges, cells=cells, element=family, origin=tuple(-0.5 * np.array(edges)))
        body = b.add_solid(turned(mesh, at, axes), element=family, material=material, name=name)
    b.add_probe(name, body.at(tuple(at)))


def turned(mesh, at, axes):
    """The mesh about a point, with these axes."""
    return mesh.transformed(transform=(axes, at))
