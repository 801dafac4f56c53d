"""The problems of `warpfea bench`: bodies clamped at one end and loaded at the other from t = 0, without gravity.

All of SVK, E = 7e8 Pa, nu = 0.33, 2700 kg/m^3.

bar: T10, 3 x 2 x 1 m; 5000 N in +x as a uniform traction on the face x = 3.
beam: 3243, elements of 0.5 x 0.1 x 0.1 m in a row, eta = lambda_v = 1e5 Pa s; 3100 N in +z at the last node.
plate: 3443, 4 x 2 x 0.1 m, twice as many elements along x as along y; 1000 N in -z on the edge x = 4.
ENMC, FN18, H3843: the bar of these ANCF solids.

The tip is the mean of the loaded face, node or edge, along the load.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from ... import mesh as meshes
from ...builder.builder import ModelBuilder
from ...elements.sections import Rectangle
from ...materials import SVK, KelvinVoigt
from ...mesh import Mesh

__all__ = ["PROBLEMS", "Problem"]

E, NU, DENSITY = 7e8, 0.33, 2700.0
LAW = SVK(E=E, nu=NU, density=DENSITY)
DAMPED_LAW = SVK(E=E, nu=NU, density=DENSITY, damping=KelvinVoigt(eta=1e5, lambda_v=1e5))
BAR_SIZE = (3.0, 2.0, 1.0)
BEAM_SIDE = 0.1
PLATE_SIZE = (4.0, 2.0)
PLATE_THICKNESS = 0.1


@dataclass(frozen=True)
class Problem:
    """A problem in many sizes.

    Attributes:
        name: as users choose it.
        size_for: wanted unknowns -> size.
        unknowns: size -> its unknowns.
        build: size, and by keyword the law and the load over its area (Pa) -> ModelBuilder with the probe "tip".
        tip_axis: component of the tip's displacement that is compared.
        min_unknowns: of its smallest size.
        default_unknowns: unknowns of a run without --unknowns.
    """

    name: str
    size_for: Callable[[int], Any]
    unknowns: Callable[[Any], int]
    build: Callable[..., ModelBuilder]
    tip_axis: int
    min_unknowns: int
    default_unknowns: tuple[int, ...]


def bar_unknowns(cells: tuple[int, int, int]) -> int:
    """Unknowns of a T10 box whose face x = 0 is clamped."""
    nx, ny, nz = cells
    return 3 * (2 * nx) * (2 * ny + 1) * (2 * nz + 1)


def ancf_solid_unknowns(cells: tuple[int, int, int]) -> int:
    """Unknowns of a box of ANCF solids with slots at the corners alone (FN18, H3843); x = 0 is clamped."""
    nx, ny, nz = cells
    return 12 * nx * (ny + 1) * (nz + 1)


def enmc_unknowns(cells: tuple[int, int, int]) -> int:
    """Those of ENMC, which has a position at each face of its six tetrahedra per cell too."""
    nx, ny, nz = cells
    faces = 12 * nx * ny * nz + 2 * (nx * ny + ny * nz + nz * nx)
    return ancf_solid_unknowns(cells) + 3 * (faces - 2 * ny * nz)


def bar_cells(unknowns: int, count: Callable[[tuple[int, int, int]], int] = bar_unknowns) -> tuple[int, int, int]:
    """Cells close to the proportion 3 : 2 : 1 whose number of unknowns, `count`, is nearest in ratio."""
    limit = 2.0 * (unknowns / 72.0) ** (1.0 / 3.0) + 2.0
    choices = {tuple(max(1, round(k * s)) for k in (3, 2, 1)) for s in np.arange(1.0, limit, 0.05)}
    best = min(sorted(choices), key=lambda cells: abs(np.log(count(cells) / unknowns)))  # type: ignore[arg-type]
    return best[0], best[1], best[2]


def bar(
    size: tuple[int, int, int] | Mesh, *, element: str = "T10", law: SVK = LAW,
    traction: float = 5000.0 / (BAR_SIZE[1] * BAR_SIZE[2]),
) -> ModelBuilder:  # fmt: skip
    """The bar of T10 or other solid elements, structured with so many cells or on any mesh of the box."""
    b = ModelBuilder(gravity=(0.0, 0.0, 0.0))
    mesh = size if isinstance(size, Mesh) else meshes.box(BAR_SIZE, cells=size, element=element)
    body = b.add_solid(mesh, material=law, element=element, name="bar")
    end = body.surface(lambda X: X[:, 0] > BAR_SIZE[0] - 1e-9)
    b.clamp(body.nodes(lambda X: X[:, 0] < 1e-9))
    b.add_traction(end, (traction, 0.0, 0.0))
    b.add_probe("tip", end)
    return b


def beam(elements: int, *, law: SVK = DAMPED_LAW, traction: float = 3100.0 / BEAM_SIDE**2) -> ModelBuilder:
    """The beam of 3243 elements."""
    b = ModelBuilder(gravity=(0.0, 0.0, 0.0))
    body = b.add_beam(
        [(0.0, 0.0, 0.0), (0.5 * elements, 0.0, 0.0)],
        elements=elements, section=Rectangle(BEAM_SIDE, BEAM_SIDE), normal=(0.0, 0.0, 1.0), material=law,
    )  # fmt: skip
    b.clamp(body.start)
    b.add_point_load(body.end, (0.0, 0.0, traction * BEAM_SIDE**2))
    b.add_probe("tip", body.end)
    return b


def plate(
    cells: int | tuple[int, int], *, law: SVK = LAW, traction: float = 1000.0 / (PLATE_SIZE[1] * PLATE_THICKNESS)
) -> ModelBuilder:
    """The plate of 3443 elements, 2 cells x cells, or so many along x and along y."""
    b = ModelBuilder(gravity=(0.0, 0.0, 0.0))
    mesh = meshes.grid(PLATE_SIZE, cells=(2 * cells, cells) if isinstance(cells, int) else cells)
    body = b.add_shell(mesh, thickness=PLATE_THICKNESS, material=law)
    b.clamp(body.edge("x-"))
    b.add_traction(body.surface("x+"), (0.0, 0.0, -traction))
    b.add_probe("tip", body.edge("x+"))
    return b


def _ancf_solid_problem(element: str, count: Callable[[tuple[int, int, int]], int]) -> Problem:
    """The bar of an ANCF solid."""
    size_for = partial(bar_cells, count=count)
    return Problem(element, size_for, count, partial(bar, element=element), 0, count((3, 2, 1)), (1000, 10000))


def _plate_unknowns(cells: int) -> int:
    return 12 * 2 * cells * (cells + 1)


PROBLEMS = {
    "bar": Problem("bar", bar_cells, bar_unknowns, bar, 0, bar_unknowns((3, 2, 1)), (1000, 10000)),
    "beam": Problem(
        "beam", lambda n: max(1, round(n / 12)), lambda k: 12 * k, beam, 2, 12, (360, 3600, 12000, 36000, 120000)
    ),
    "plate": Problem(
        "plate",
        lambda n: max(1, round((np.sqrt(1.0 + n / 6.0) - 1.0) / 2.0)),
        _plate_unknowns, plate, 2, _plate_unknowns(1), (480, 1728, 6528, 25344, 99840),
    ),
    "ENMC": _ancf_solid_problem("ENMC", enmc_unknowns),
    "FN18": _ancf_solid_problem("FN18", ancf_solid_unknowns),
    "H3843": _ancf_solid_problem("H3843", ancf_solid_unknowns),
}  # fmt: skip
