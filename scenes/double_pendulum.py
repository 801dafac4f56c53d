"""A double pendulum of two soft or rigid links."""

import numpy as np

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=4e-3, t_end=1.6, integrator="bdf2", tol=1e-4, fps=120.0, speed=0.25, picture=0.34)
def double_pendulum(
    *,
    length: float = 0.4,
    width: float = 0.06,
    depth: float = 0.04,
    cells: int = 6,
    E: float = 4e6,
    nu: float = 0.3,
    density: float = 1100.0,
    rigid: bool = False,
) -> wf.ModelBuilder:
    """Two soft T10 links, hung one behind the other on hinges, are let go from the horizontal, and bend as they swing.

    The links lie side by side along the axis of their hinge, y. A hinge acts on all nodes at the end of a link, by
    their mean position and rotation.

    Args:
        length: of a link from hinge to hinge, m.
        width: of a link, along the hinges, m.
        depth: of a link, along gravity, m; a link extends half of it beyond its hinges.
        cells: along a link; each is cut into six tetrahedra.
        E: Young's modulus (SVK), Pa.
        nu: Poisson's ratio.
        density: kg/m^3.
        rigid: rigid links in place of soft ones.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    rubber = wf.SVK(E=E, nu=nu, density=density)
    size = (length + depth, width, depth)
    hold = max(depth, 0.5 * size[0] / cells) + 1e-6 * length  # at least two layers of nodes: one alone has no rotation

    def link(name: str, low: np.ndarray) -> wf.Body:
        mesh = wf.mesh.box(size, cells=(cells, 1, 1), origin=low, name=name)
        if rigid:
            return b.add_rigid(mesh, density=density, name=name)
        return b.add_solid(mesh, material=rubber)

    low = np.array([-0.5 * depth, -width, -0.5 * depth])
    upper = link("upper link", low)
    lower = link("lower link", low + (length, width, 0.0))
    here = lower.mesh.bounding_box()[0][0]
    axis = (0, -1, 0)
    first = upper.nodes(lambda X: X[:, 0] < low[0] + hold)
    last = upper.nodes(lambda X: X[:, 0] > low[0] + size[0] - hold)
    next_first = lower.nodes(lambda X: X[:, 0] < here + hold)
    b.add_joint("revolute", parent=wf.GROUND, child=first, anchor=(0, -0.5 * width, 0), axis=axis, name="pivot")
    b.add_joint("revolute", parent=last, child=next_first, anchor=(length, 0, 0), axis=axis, name="elbow")
    b.add_probe("elbow", upper.surface("x+"))
    b.add_probe("tip", lower.surface("x+"))
    return b
