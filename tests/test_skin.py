"""Fine surfaces skinned on coarse meshes."""

import numpy as np
import pytest

import warpfea as wf
from warpfea.model.surfaces import reference_points
from warpfea.terms.fields import field_at_points

STEEL = wf.SVK(E=1e6, nu=0.3, density=1000.0)


def fine_sphere(radius=0.5, cells=8):
    """Points and triangles of a sphere about (0.5, 0, 0)."""
    ball = wf.mesh.sphere(radius, cells=cells, center=(0.5, 0.0, 0.0))
    nodes, triangles = np.unique(ball.faces("surface")[:, :3], return_inverse=True)
    return ball.points[nodes], triangles.reshape(-1, 3)


def bodies(b):
    """A body of each kind of shape functions, each around the sphere of radius 0.1 or 0.5 about (0.5, 0, 0)."""
    ball = wf.mesh.sphere(0.5, cells=2, center=(0.5, 0.0, 0.0))
    cube = wf.mesh.box((1.2, 1.2, 1.2), cells=(2, 2, 2), origin=(-0.1, -0.6, -0.6), element="T4")
    yield b.add_solid(ball, material=STEEL, name="T10")
    yield b.add_solid(cube, material=STEEL, name="T4")
    yield b.add_solid(cube, material=STEEL, element="FN", name="FN")
    curve = [(0, 0, 0), (1, 0, 0)]
    section = wf.Rectangle(0.3, 0.3)
    yield b.add_beam(curve, elements=2, section=section, normal=(0, 0, 1), material=STEEL, name="beam")
    grid = wf.mesh.grid((1, 1), cells=(2, 2), origin=(0, -0.5, 0))
    yield b.add_shell(grid, thickness=0.2, material=STEEL, name="shell")
    yield b.add_rigid(wf.Box((0.5, 0, 0), (1, 1, 1)), density=1000.0, name="rigid")


@pytest.fixture(scope="module")
def skinned():
    b = wf.ModelBuilder()
    out = []
    for body in bodies(b):
        points, triangles = fine_sphere(0.5 if body.family.solid else 0.18)  # outside of the beam and the shell
        b.add_skin(body, (points, triangles), distance=0.1)
        out.append((body, points))
    return out


@pytest.mark.parametrize("stretch", [np.eye(3), [(1.2, 0.1, -0.3), (0, 0.8, 0.2), (0.1, 0, 1.1)]], ids=["rigid", "F"])
def test_a_skin_follows_exactly(skinned, stretch):
    """In a rigid motion and a homogeneous deformation, vertices within the elements and outside of them."""
    c, s = np.cos(2.0), np.sin(2.0)
    F, t = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ stretch, np.array([3.0, -1.0, 2.0])
    for body, points in skinned:
        position = (body.slot_kind == 0)[:, None]
        E = body.reference + position * body.origin
        u = E @ F.T + position * t - E
        found = reference_points(body, body.skin.slot_weights) + body.skin.slot_weights @ u
        assert found.shape == points.shape
        assert np.abs(found - (points @ F.T + t)).max() < 1e-12, body.name


def test_fields_of_a_skin():
    """J = 1 + 0.2 X of a quadratic motion, at the vertices within the body and at the nearest points of the others;
    velocities are those of the vertices."""
    b = wf.ModelBuilder()
    body = b.add_solid(wf.mesh.box((1, 1, 1), cells=(2, 2, 2)), material=STEEL)
    points = np.random.default_rng(0).uniform(-0.1, 1.1, (300, 3))
    b.add_skin(body, (points, np.arange(300).reshape(100, 3)), distance=0.2)
    model = b.finalize(device="cpu")
    state = model.state()
    X = body.reference + body.origin
    state.displacement.assign(np.column_stack([0.1 * X[:, 0] ** 2, 0 * X[:, :2]])[None])
    state.velocity.assign(X[None])
    nearest = np.clip(points, 0.0, 1.0)
    assert 50 < (nearest == points).all(axis=1).sum() < 250
    J, v = (field_at_points(model.terms, name, body, state, body.skin)[0] for name in ("J", "velocity"))
    assert np.abs(J - (1.0 + 0.2 * nearest[:, 0])).max() < 1e-12
    assert np.abs(v - points).max() < 1e-12


def test_vertices_within_elements_take_their_shape_functions():
    """At its nodes, those of curved sides among them, a body's skin is what the body is, in any state."""
    b = wf.ModelBuilder()
    body = b.add_solid(wf.mesh.sphere(1.0, cells=2), material=STEEL)
    b.add_skin(body, (body.mesh.points, [[0, 1, 2]]))
    nodes = np.eye(body.slot_count)[body.node_slot]
    assert np.abs(body.skin.slot_weights - nodes).max() < 1e-12


def test_a_skin_too_far_is_refused_by_name(tmp_path):
    b = wf.ModelBuilder()
    body = b.add_solid(wf.mesh.box((1, 1, 1), cells=(1, 1, 1)), material=STEEL, name="cube")
    points, triangles = fine_sphere()
    with pytest.raises(
        wf.ModelError, match=rf"add_skin\('cube'\): \d+ of {len(points)} .* outside of body 'cube'.* distance="
    ):
        b.add_skin(body, (points, triangles), scale=1000.0)
    with pytest.raises(
        wf.ModelError, match=r"1 of 3 vertices lie further than distance = 0\.1 m .*, the first is vertex 2"
    ):
        b.add_skin(body, ([(0, 0, 0.5), (0.5, 0.5, 1.099), (1.09, 0.5, 1.09)], [[0, 1, 2]]), distance=0.1)
    with pytest.raises(wf.ModelError, match=r"distance = -1"):
        b.add_skin(body, (points, triangles), distance=-1)
    with pytest.raises(wf.MeshError, match=r"no\.obj"):
        b.add_skin(body, tmp_path / "no.obj")
    with pytest.raises(wf.ModelError, match="add_skin"):
        wf.ModelBuilder().add_skin(body, (points, triangles))
    assert "skin" not in vars(body)  # nothing is made of those


def test_outputs_draw_the_skin_and_nothing_else_changes(tmp_path):
    """USD, picture and page have the file's triangles; states, kernels and arrays are those without it."""
    from pxr import Usd, UsdGeom

    points, triangles = fine_sphere(0.3, cells=6)
    rows = [f"v {x} {y} {z}" for x, y, z in points] + [f"f {a} {b} {c}" for a, b, c in triangles + 1]
    (tmp_path / "fine.obj").write_text("\n".join(rows))
    facts, states = [], []
    for fine in (False, True):
        b = wf.ModelBuilder()
        body = b.add_solid(wf.mesh.box((1, 1, 1), cells=(1, 1, 1), origin=(0, -0.5, -0.5)), material=STEEL)
        if fine:
            b.add_skin(body, str(tmp_path / "fine.obj"))
        model = b.finalize(device="cpu")
        sim = wf.Simulation(model, dt=1e-3)
        files = [tmp_path / f"{fine}.{end}" for end in ("usda", "png", "html")]
        writers = [wf.USDWriter(files[0]), wf.PNGWriter(files[1], size=(160, 120), edges=True), wf.HTMLWriter(files[2])]
        sim.run(t_end=2e-3, outputs=writers)
        facts.append(model.info())
        states.append(sim.state.displacement.numpy())
        stage = Usd.Stage.Open(str(files[0]))
        mesh = next(UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.GetName() == "skin")
        drawn = np.asarray(mesh.GetPointsAttr().Get(0.0)), np.asarray(mesh.GetFaceVertexIndicesAttr().Get())
        assert np.array_equal(drawn[1].reshape(-1, 3), body.skin.triangles)
        assert all(file.stat().st_size > 0 for file in files)
    assert len(drawn[0]) == len(points)
    assert np.array_equal(drawn[1].reshape(-1, 3), triangles)
    assert len(body.face_skin.triangles) == 48  # what a check of overlaps takes
    assert facts[0] == facts[1]
    assert np.array_equal(*states)
    assert (tmp_path / "True.png").read_bytes() != (tmp_path / "False.png").read_bytes()
