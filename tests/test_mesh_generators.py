"""Generators of quads and hexahedra; conversions between cell types."""

from __future__ import annotations

import numpy as np
import pytest
from quad_meshes import area_vectors, plate

from warpfea.base.errors import MeshError
from warpfea.mesh import CELL_TYPES, Mesh, box, check, cylinder, grid, linear, sphere
from warpfea.mesh.cells import ELEMENT_CELLS
from warpfea.mesh.convert import with_face_nodes

# generators


def test_grid():
    mesh = grid((4, 2), cells=(5, 3), origin=(1, 2, 3))
    assert check(mesh) is mesh
    assert (mesh.cell_type, mesh.name, mesh.orphan_nodes.size, mesh.surface_sets) == ("quad", "plate", 0, {})
    assert (len(mesh.cells), len(mesh.points)) == (15, 24)
    np.testing.assert_allclose(mesh.volumes(), 8 / 15, rtol=1e-14)
    np.testing.assert_array_equal(mesh.bounding_box(), [(1, 2, 3), (5, 4, 3)])
    x = mesh.points[mesh.cells]
    normal = np.cross(x[:, 1] - x[:, 0], x[:, 3] - x[:, 0])
    np.testing.assert_allclose(normal, np.tile([0, 0, 8 / 15], (15, 1)), atol=1e-14)
    for name, axis, value in (("x-", 0, 1), ("x+", 0, 5), ("y-", 1, 2), ("y+", 1, 4)):
        np.testing.assert_array_equal(mesh.nodes(name), np.flatnonzero(mesh.points[:, axis] == value))
    assert sorted(mesh.node_sets) == ["x+", "x-", "y+", "y-"]


def test_boundary_of_quads_is_the_rim_walked_around_once():
    mesh = plate()
    rim = mesh.faces(mesh.boundary())
    assert rim.shape == (8, 2)
    np.testing.assert_array_equal(np.sort(rim[:, 0]), [0, 1, 2, 3, 5, 6, 7, 8])
    np.testing.assert_array_equal(np.sort(rim[:, 1]), [0, 1, 2, 3, 5, 6, 7, 8])
    np.testing.assert_allclose(mesh.face_centroids(mesh.boundary())[0], (0.6, -0.7, 1 / 3))
    left = mesh.surface(lambda X: X[:, 0] < 0.1 + 1e-9)
    np.testing.assert_array_equal(np.unique(mesh.faces(left)), mesh.nodes("x-"))


def tube(turns: float):
    """Roll the unit square about the y axis, so that the normals point outward."""
    return lambda X: np.column_stack(
        [np.cos(2 * np.pi * turns * X[:, 0]), X[:, 1], -np.sin(2 * np.pi * turns * X[:, 0])]
    )


def test_grid_rolled_to_a_tube_is_closed():
    half, full = (grid((1, 1), cells=(40, 3), map=tube(t)) for t in (0.5, 1.0))
    chord = 2 * np.sin(np.pi / 40)
    assert len(half.points) == 41 * 4
    assert len(half.boundary()) == 2 * (40 + 3)
    assert (len(full.points), len(full.cells), len(full.boundary())) == (40 * 4, 120, 80)
    assert full.volume() == pytest.approx(40 * chord, rel=1e-13)
    np.testing.assert_array_equal(full.nodes("x-"), full.nodes("x+"))
    assert len(full.nodes("y-")) == 40
    rim = np.unique(full.faces(full.boundary()))
    np.testing.assert_array_equal(rim, np.union1d(full.nodes("y-"), full.nodes("y+")))
    x = full.points[full.cells]
    outward = np.cross(x[:, 1] - x[:, 0], x[:, 3] - x[:, 0])
    middle = full.centroids() * (1, 0, 1)
    assert (np.einsum("mi,mi->m", outward, middle) > 0).all()


def test_a_torus_has_no_rim():
    def torus(X):
        a, b = 2 * np.pi * X[:, 0], 2 * np.pi * X[:, 1]
        return np.column_stack([(2 + np.cos(b)) * np.cos(a), (2 + np.cos(b)) * np.sin(a), np.sin(b)])

    mesh = grid((1, 1), cells=(24, 16), map=torus)
    assert (len(mesh.points), len(mesh.boundary())) == (24 * 16, 0)
    assert mesh.volume() == pytest.approx(8 * np.pi**2, rel=0.02)


def test_a_moebius_band_is_refused():
    def band(X):
        a, s = 2 * np.pi * X[:, 0], X[:, 1] - 0.5
        r = 2 + s * np.cos(a / 2)
        return np.column_stack([r * np.cos(a), r * np.sin(a), s * np.sin(a / 2)])

    with pytest.raises(MeshError, match=r"plate: nodes \d+ and \d+ coincide"):
        grid((1, 1), cells=(20, 2), map=band)


@pytest.mark.parametrize(("element", "cell_type"), ELEMENT_CELLS.items())
def test_box_of_each_element(element, cell_type):
    mesh = check(box((1.0, 0.5, 0.2), cells=(4, 3, 2), element=element, origin=(1, 2, 3)))
    assert (
        mesh.cell_type
        == cell_type
        == ("hexahedron" if element == "H3843" else "tetra10" if "10" in element else "tetra")
    )
    assert len(mesh.cells) == (24 if element == "H3843" else 6 * 24)
    assert mesh.volume() == pytest.approx(0.1, rel=1e-13)


def test_box_of_hexahedra():
    mesh = box((1.0, 0.5, 0.2), cells=(4, 3, 2), element="H3843", origin=(1, 2, 3))
    np.testing.assert_array_equal(
        mesh.points, box((1, 0.5, 0.2), cells=(4, 3, 2), element="T4", origin=(1, 2, 3)).points
    )
    np.testing.assert_array_equal(mesh.cells[0], [0, 1, 6, 5, 20, 21, 26, 25])
    areas = {"x": 0.1, "y": 0.2, "z": 0.5}
    for k, axis in enumerate("xyz"):
        for sign, end in (("-", 0), ("+", 1)):
            vector = area_vectors(mesh, axis + sign).sum(axis=0)
            np.testing.assert_allclose(vector, (2 * end - 1) * areas[axis] * np.eye(3)[k], atol=1e-15)
            at = mesh.bounding_box()[end][k]
            np.testing.assert_array_equal(mesh.nodes(axis + sign), np.flatnonzero(mesh.points[:, k] == at))
    table = np.concatenate(list(mesh.surface_sets.values()))
    np.testing.assert_array_equal(table[np.lexsort(table.T[::-1])], mesh.boundary())


def ring(X):
    """Radius 1 + x, angle y, height z."""
    return np.column_stack([(1 + X[:, 0]) * np.cos(X[:, 1]), (1 + X[:, 0]) * np.sin(X[:, 1]), X[:, 2]])


@pytest.mark.parametrize(("element", "order"), [("H3843", 2.0), ("T4", 2.0), ("T10", 4.0)])
def test_mapped_box_converges(element, order):
    exact = np.pi / 4 * (4 - 1)
    error = [
        abs(1 - box((1, np.pi / 2, 1), cells=(n, 2 * n, 1), element=element, map=ring).volume() / exact) for n in (2, 4)
    ]
    assert np.log2(error[0] / error[1]) == pytest.approx(order, abs=0.2)


@pytest.mark.parametrize(
    ("make", "pattern"),
    [
        (lambda: grid((1, 0), cells=(1, 1)), r"^grid: size must be positive, got \[1\.0, 0\.0\]"),
        (lambda: grid((1, 1, 1), cells=(1, 1)), r"grid: size: expected 2 numbers"),
        (lambda: grid((1, 1), cells=4), r"grid: cells: expected 2 numbers, got 4"),
        (lambda: grid((1, 1), cells=(2, 1.5)), r"grid: cells must be integers of at least 1"),
        (lambda: grid((1, 1), cells=(1, 1), origin=(0, 0, np.nan)), r"grid: origin must be finite"),
        (lambda: grid((1, 1), cells=(1, 1), map=3), r"grid: map must be a function .*, got int"),
        (
            lambda: grid((1, 1), cells=(1, 1), map=lambda X: X[:, :2]),
            r"grid: map must return .* shape \(4, 3\), got shape",
        ),
        (lambda: grid((1, 1), cells=(1, 1), map=lambda X: None), r"grid: map must return numbers of shape \(4, 3\)"),
        (lambda: grid((1, 1), cells=(1, 1), map=lambda X: X / np.where(X > 2, 1.0, np.nan)), r"of the point \[0\.0"),
        (lambda: grid((1, 1), cells=(2, 2), map=lambda X: 0 * X), r"plate: elements 0 and 1 have the same"),
        (lambda: grid((1, 1), cells=(2, 2), map=lambda X: X * X[:, :1]), r"plate: nodes 0 and 3 coincide"),
        (lambda: box((1, 1, 1), cells=(1, 1, 1), element="H20"), r"unknown element 'H20', known are T4, .*, H3843$"),
        (lambda: box((1, 1, 1), cells=(1, 1, 1), map=lambda X: -X), r"box: all 6 elements are inverted .* is mirrored"),
        (
            lambda: box((1, 1, 1), cells=(2, 1, 1), element="H3843", map=lambda X: X * (X - 0.9)),
            r"box: element 0 is inverted: smal",
        ),
        (
            lambda: box((1, 1, 1), cells=(1, 1, 1), map=lambda X: X[0]),
            r"box: map must return .* \(27, 3\), got shape \(3,\)",
        ),
        (lambda: cylinder(1, 1, cells=(2, 1), element="H3843"), r"cylinder: element 'H3843' isn't available"),
        (lambda: sphere(1, cells=2, element="H3843"), r"sphere: element 'H3843' isn't available"),
    ],
)
def test_bad_generator_argument(make, pattern):
    with pytest.raises(MeshError, match=pattern), np.errstate(all="ignore"):
        make()


# conversions


def test_linear():
    fine = box((1, 2, 3), cells=(2, 2, 1))
    mixed = Mesh(
        np.vstack([[(9.0, 9, 9)], fine.points]),
        fine.cells + 1,
        "tetra10",
        node_sets={"mid": fine.cells[:2, 7] + 1, "some": [0, 1, 2, 3], **{k: v + 1 for k, v in fine.node_sets.items()}},
        element_sets={"half": np.arange(12)},
        surface_sets=fine.surface_sets,
        name="part",
        path="part.msh",
    )
    mesh, expected = linear(mixed), box((1, 2, 3), cells=(2, 2, 1), element="T4")
    assert (mesh.cell_type, mesh.name, mesh.path) == ("tetra", "part", "part.msh")
    np.testing.assert_array_equal(mesh.points, np.vstack([[(9.0, 9, 9)], expected.points]))
    np.testing.assert_array_equal(mesh.cells, expected.cells + 1)
    np.testing.assert_array_equal(mesh.orphan_nodes, [0])
    assert mesh.nodes("mid").size == 0
    np.testing.assert_array_equal(mesh.nodes("some"), [0, 1, 2])  # node 2 of the file is a mid-edge node
    np.testing.assert_array_equal(mesh.elements("half"), np.arange(12))
    for name in expected.surface_sets:
        np.testing.assert_array_equal(mesh.nodes(name), expected.nodes(name) + 1)
        np.testing.assert_array_equal(mesh.surface(name), expected.surface(name))
    assert linear(mesh) is mesh


def test_linear_refuses():
    with pytest.raises(MeshError, match=r"plate: linear\(\) takes tetra10 \(or tetra\) cells, the mesh has quad"):
        linear(plate())
    # corners 0 and 1 change places: the bent edges could hold this together, straight ones can't
    cells = box((1, 1, 1), cells=(1, 1, 1)).cells.copy()
    cells[2, :2] = cells[2, 1::-1]
    twisted = Mesh(box((1, 1, 1), cells=(1, 1, 1)).points, cells, "tetra10", name="part")
    with pytest.raises(MeshError, match=r"part: element 2 is inverted.*straight edges between the corners"):
        linear(twisted)


@pytest.fixture
def block() -> Mesh:
    mesh = box((2, 1, 1), cells=(2, 2, 1), element="T4", name="block")
    inner = mesh.nodes(lambda X: X[:, 0] == 1.0)
    return Mesh(
        mesh.points,
        mesh.cells,
        "tetra",
        node_sets={
            **mesh.node_sets,
            "inner": inner,
            "left": np.unique(mesh.cells[:12]),
            "loose": mesh.nodes("x-"),
            "edge": mesh.nodes(lambda X: X[:, 0] + X[:, 1] == 0.0),
            "part": mesh.nodes("z+"),
        },
        element_sets={"left": np.arange(12)},
        surface_sets={**mesh.surface_sets, "part": mesh.surface("z+")[:3]},
        name="block",
    )


def test_face_nodes_are_shared(block):
    mesh = with_face_nodes(block)
    assert (mesh.cell_type, mesh.name) == ("tetra_faces", "block")
    n = len(block.points)
    corners = np.sort(block.cells[:, CELL_TYPES["tetra"].faces].reshape(-1, 3), axis=1)
    assert len(mesh.points) - n == len(np.unique(corners, axis=0)) == (4 * 24 + len(block.boundary())) // 2
    np.testing.assert_array_equal(mesh.points[:n], block.points)
    np.testing.assert_array_equal(mesh.cells[:, :4], block.cells)
    np.testing.assert_allclose(
        mesh.points[mesh.cells[:, 4:]].reshape(-1, 3), block.points[corners].mean(axis=1), atol=1e-15
    )
    uses = np.bincount(mesh.cells[:, 4:].ravel() - n)
    assert sorted(np.unique(uses)) == [1, 2]
    np.testing.assert_array_equal(np.sort(mesh.cells[:, 4:].ravel()[:4]), n + np.arange(4))  # as the elements come
    assert check(mesh).volume() == pytest.approx(2.0, rel=1e-14)
    np.testing.assert_array_equal(mesh.boundary(), block.boundary())
    on_sides = mesh.faces("x+")
    assert on_sides.shape[1] == 4
    np.testing.assert_array_equal(mesh.points[on_sides[:, 3], 0], 2.0)
    again = with_face_nodes(block)
    np.testing.assert_array_equal(again.cells, mesh.cells)


def test_face_nodes_in_sets(block):
    mesh = with_face_nodes(block)
    n = len(block.points)
    added = lambda name: mesh.nodes(name)[len(block.nodes(name)) :]  # noqa: E731
    for name in block.node_sets:
        np.testing.assert_array_equal(mesh.nodes(name)[: len(block.nodes(name))], block.nodes(name))
        assert (added(name) >= n).all()
        assert (np.diff(mesh.nodes(name)) > 0).all()
    for name, axis, value in (("x-", 0, 0), ("x+", 0, 2), ("y-", 1, 0), ("z+", 2, 1)):
        at = np.flatnonzero(np.abs(mesh.points[:, axis] - value) < 1e-12)
        np.testing.assert_array_equal(mesh.nodes(name), at)
    assert len(added("inner")) == 0  # no surface of that name, and inside
    np.testing.assert_array_equal(added("loose"), added("x-"))  # outer faces
    assert len(added("edge")) == 0
    np.testing.assert_array_equal(added("part"), np.sort(mesh.faces("part")[:, 3]))  # 3 of the 8 of z+
    np.testing.assert_array_equal(added("left"), np.unique(mesh.cells[:12, 4:]))  # all faces of its elements
    for name in block.surface_sets:
        np.testing.assert_array_equal(mesh.surface(name), block.surface(name))
    np.testing.assert_array_equal(mesh.elements("left"), np.arange(12))


def test_face_points_of_a_curved_source(block):
    corners = block.points[block.cells[:, CELL_TYPES["tetra"].faces]]
    curved = corners.mean(axis=2) + 0.01 * np.sin(corners.mean(axis=2))
    mesh = with_face_nodes(block, face_points=curved)
    np.testing.assert_allclose(mesh.points[mesh.cells[:, 4:]], curved, atol=1e-14)
    lost, torn = curved.copy(), curved.copy()
    lost[3, 2, 1] = np.nan
    inner = np.argwhere(np.bincount(mesh.cells[:, 4:].ravel())[mesh.cells[:, 4:]] == 2)[0]
    torn[tuple(inner)] += (0, 0, 0.1)
    for points, pattern in (
        (curved[:, :3], r"block: face_points have shape \(24, 3, 3\), expected \(24, 4, 3\)"),
        (lost, r"block: face_points of element 3, face 2 are \[.*nan.*\]: not finite"),
        (torn, r"block: face_points differ by 0\.1 m between face \d of element \d+ and face \d of element \d+"),
    ):
        with pytest.raises(MeshError, match=pattern):
            with_face_nodes(block, face_points=points)
    with pytest.raises(MeshError, match=r"box: face nodes need tetra cells, the mesh has tetra10"):
        with_face_nodes(box((1, 1, 1), cells=(1, 1, 1)))
