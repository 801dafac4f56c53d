"""A peg that is pressed into a hole and pulled out again."""

import numpy as np

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=5e-3, t_end=0.8, tol=1e-6, fps=60.0, speed=0.5, picture=0.4)
def peg_in_hole(
    *,
    taper: float = 0.1,
    mu: float = 0.2,
    side: float = 0.04,
    height: float = 0.05,
    wall: float = 0.02,
    clearance: float = 0.0002,
    press: float = 0.004,
    cells: int = 2,
    E: float = 1e7,
    nu: float = 0.3,
    density: float = 1200.0,
) -> wf.ModelBuilder:
    """A tapered peg is pressed between the four walls of a hole, where friction holds it, and pulled out again.

    By Coulomb's law the force along the peg is the normal force on its sides times sin a + mu cos a on the way in, and
    times sin a - mu cos a on the way out, tan a the taper: below 0, where the peg must be pulled, with mu above tan a.

    Args:
        taper: tangent of the angle between a side and the axis.
        mu: coefficient of friction.
        side: width of the hole at its bottom, m.
        height: of the walls, m; the peg is twice as high.
        wall: thickness of the walls, m.
        clearance: distance of peg and walls at the start, m.
        press: way of the peg's top after the first touch, m.
        cells: along the edges of a wall.
        E: Young's modulus of the peg (SVK), Pa; that of the walls is ten times as large.
        nu: Poisson's ratio.
        density: kg/m^3.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    soft, hard = (wf.SVK(E=f * E, nu=nu, density=density, damping=wf.KelvinVoigt(eta=2e-3 * f * E)) for f in (1, 10))

    def grown(X: np.ndarray) -> np.ndarray:
        wide = 1.0 + 2.0 * taper / side * X[:, 2]
        return np.column_stack([wide * X[:, 0], wide * X[:, 1], X[:, 2] + clearance / taper])

    size, low = (side, side, 2.0 * height), (-0.5 * side, -0.5 * side, -0.5 * height)
    mesh = wf.mesh.box(size, cells=(cells, cells, 2 * cells), origin=low, element="T10", map=grown)
    peg = b.add_solid(mesh, material=soft, name="peg")
    way = clearance / taper + press
    path = [(0, 0, 0), (0, 0, -way), (0, 0, -way), (0, 0, 0)]
    b.drive(peg.nodes("z+"), displacement=([0.0, 0.4, 0.45, 0.8], path))
    for k, name in enumerate(("x+", "y+", "x-", "y-")):

        def inclined(X: np.ndarray, k: int = k) -> np.ndarray:
            x = X[:, 0] + taper * X[:, 2] * (1.0 - (X[:, 0] - 0.5 * side) / wall)
            turn = np.linalg.matrix_power(np.array([[0.0, -1.0], [1.0, 0.0]]), k)
            return np.column_stack([np.column_stack([x, X[:, 1]]) @ turn.T, X[:, 2]])

        mesh = wf.mesh.box(
            (wall, 0.8 * side, height), cells=(1, cells, cells), origin=(0.5 * side, -0.4 * side, 0.0), map=inclined
        )
        body = b.add_solid(mesh, material=hard, name=f"wall {name}")
        b.clamp(body.nodes("x+"))
        b.add_contact(peg.surface(name), body.surface("x-"), mu=mu, name=f"at {name}")
    b.add_probe("tip", peg.surface("z-"))
    return b
