"""Meshes of hexahedra and of quads: what checks find."""

from __future__ import annotations

import numpy as np
import pytest
from quad_meshes import Q, brick, shell_parts, write

from warpfea.base.errors import MeshError
from warpfea.mesh import Mesh, box, check, grid, read


def _changed(mesh: Mesh, *, move=None, cells=None, name="part") -> Mesh:
    points = mesh.points.copy()
    for node, x in (move or {}).items():
        points[node] = x
    return Mesh(points, mesh.cells if cells is None else np.array(cells), mesh.cell_type, name=name)


def _flat_plate(**change) -> Mesh:
    return _changed(grid((2, 2), cells=(2, 2)), **change)


def _branch() -> Mesh:
    points = np.array([(0, 0, 0), (0, 1, 0), (1, 0, 0), (1, 1, 0), (-1, 0, 0), (-1, 1, 0), (0, 0, 1), (0, 1, 1.0)])
    return Mesh(points, np.array([(0, 2, 3, 1), (0, 1, 5, 4), (0, 6, 7, 1)]), "quad", name="part")


ONE = box((1, 1, 1), cells=(1, 1, 1), element="H3843")
BAD = {
    "hex mirrored": (
        lambda: _changed(brick(), cells=brick().cells[:, [4, 5, 6, 7, 0, 1, 2, 3]]),
        r"all 2 elements are inverted \(element 0 has det J0 = -3 m\^3\).*swap the nodes 0 \.\. 3 and 4 \.\. 7",
    ),
    "hex inverted": (
        lambda: _changed(brick(), cells=[brick().cells[0], brick().cells[1, [4, 5, 6, 7, 0, 1, 2, 3]]]),
        r"part: element 1 is inverted: smallest det J0 = -3 m\^3, volume -3 m\^3 \(1 such element, first: 1\)",
    ),
    "hex corner": (  # volume positive, one corner pushed through
        lambda: _changed(ONE, move={7: (0.3, 0.3, 0.3)}),
        r"0 is inverted at a corner, centre or quadrature point \(too distorted\): smallest det J0 = -1\.1 m\^3, "
        r"volume 0\.475 m\^3",
    ),
    "hex flat": (  # all corners in one plane
        lambda: _changed(ONE, move={4 + k: (0.2 + 0.5 * (k % 2), 0.2 + 0.5 * (k // 2), 0) for k in range(4)}),
        r"element 0 has zero volume \(0 m\^3, longest edge 1 m; 1 such element\)",
    ),
    "hex repeated": (
        lambda: _changed(ONE, cells=[[0, 1, 3, 3, 4, 5, 7, 6]]),
        r"element 0 holds node 3 twice: .*; a cell can't be collapsed",
    ),
    "hex twice": (
        lambda: _changed(ONE, cells=[ONE.cells[0], ONE.cells[0, [1, 2, 3, 0, 5, 6, 7, 4]]]),
        r"elements 0 and 1 have the same corners",
    ),
    "quad infinite": (lambda: _flat_plate(move={4: (np.inf, 0, 0)}), r"node 4 has the coordinates \(inf, 0, 0\)"),
    "quad repeated": (lambda: _flat_plate(cells=[[0, 1, 4, 4]]), r"element 0 holds node 4 twice: \[0, 1, 4, 4\]; a ce"),
    "quad twice": (
        lambda: _flat_plate(cells=[*Q, [3, 4, 1, 0]]),
        r"elements 0 and 4 have the same corners \[0, 1, 4, 3\] \(1 duplicate element\)",
    ),
    "quad coincident": (lambda: _flat_plate(move={8: (2, 1, 0)}), r"nodes 5 and 8 coincide at \(2, 1, 0\), 0 m apart"),
    "quad without area": (
        lambda: _flat_plate(move={0: (0.2, 1, 0), 1: (0.7, 1, 0)}),
        r"quad 0 has zero area \(0 m\^2, longest edge 1 m; 1 such quad\)",
    ),
    "quad not convex": (
        lambda: _flat_plate(move={8: (1.2, 1.2, 0)}),
        r"part: quad 3 is not convex: at corner 2 \(node 8\) the edges span -0\.6 m\^2",
    ),
    "quad with a straight corner": (
        lambda: _flat_plate(move={8: (1.5, 1.5, 0)}),
        r"quad 3 is not convex: at corner 2 \(node 8\) the edges span \S+ m\^2 along the mean normal",
    ),
    "bow tie": (lambda: _flat_plate(cells=[*Q[:3], [4, 5, 7, 8]]), r"quad 3 is not convex: .* order of a walk around"),
    "flipped": (
        lambda: _flat_plate(cells=[Q[0], Q[1][::-1], Q[2], Q[3]]),
        r"quads 0 and 1 both run from node 1 to node 4 through the edge they share, .*\(2 such edges\): flip one",
    ),
    "branching": (
        _branch,
        r"edge between nodes 1 and 0 is shared by 3 quads \(0, 1, 2; 1 such edge\): .* one body per sheet",
    ),
    "no quads": (lambda: _flat_plate(cells=np.empty((0, 4), dtype=int)), r"part: no elements \(0 of type quad\)"),
    "line without length": (
        lambda: Mesh(np.array([(0, 0, 0), (1, 0, 0), (1, 0, 1e-15)]), np.array([(0, 1), (1, 2)]), "line", name="part"),
        r"nodes 1 and 2 coincide",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_check(case):
    make, pattern = BAD[case]
    with pytest.raises(MeshError, match=pattern) as caught:
        check(make())
    assert str(caught.value).startswith("part: ")


@pytest.mark.parametrize("form", ["msh41", "vtu", "inp"])
def test_what_is_read_is_checked(form, tmp_path):
    parts = shell_parts()
    parts.blocks[3] = ("quad", parts.blocks[3][1][:, ::-1], "top")
    path = write(parts, tmp_path / "flipped", form)
    with pytest.raises(MeshError, match=r"flipped\.\w+: quads 0 and 3 both run from node 4 to node 7") as caught:
        read(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_a_distorted_hexahedron_may_be_fine():
    assert check(_changed(ONE, move={7: (0.7, 0.7, 0.7)})).volume() > 0.5
