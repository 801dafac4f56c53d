"""Rigid triangle meshes: their checks, the search on the device beside brute force, and contact with them."""

import functools
import math
import time

import numpy as np
import pytest
import warp as wp
from warpfea.kernels.terms.contact_colliders import collider_functions
from warpfea.kernels.terms.contact_data import contact_struct

import warpfea as wf
from warpfea.base.launch import Launcher
from warpfea.cli import main
from warpfea.outputs.obstacles import Obstacles
from warpfea.simulation.checkpoint import save_checkpoint
from warpfea.terms.collider_meshes import mesh_tables

SIDE, DT = 0.1, 1e-3


# meshes


def boxed(size=(0.6, 0.6, 0.2), center=(0.05, 0.05, -0.102), cells=1):
    """A box whose faces are cut into cells x cells squares of two triangles each."""
    points, triangles = wf.Box(center, size).mesh()
    for _ in range(int(math.log2(cells))):
        points, triangles = halved(points, triangles)
    return wf.TriMesh(points, triangles)


def halved(points, triangles):
    """Each triangle cut into four."""
    ends = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, number = np.unique(ends, axis=0, return_inverse=True)
    m = len(points) + number.reshape(-1, 3)
    a, b, c = triangles.T
    parts = ((a, m[:, 0], m[:, 2]), (b, m[:, 1], m[:, 0]), (c, m[:, 2], m[:, 1]), (m[:, 0], m[:, 1], m[:, 2]))
    return np.concatenate([points, points[edges].mean(axis=1)]), np.concatenate([np.column_stack(p) for p in parts])


def octahedron():
    points = np.concatenate([np.eye(3), -np.eye(3)])
    x, y, z = range(3)
    triangles = [(x, y, z), (y, x + 3, z), (x + 3, y + 3, z), (y + 3, x, z)]
    return points, np.array(triangles + [(b, a, z + 3) for a, b, _ in triangles])


def ball(radius, center, halvings):
    """A ball of 8 x 4^halvings triangles with all points on the sphere."""
    points, triangles = octahedron()
    for _ in range(halvings):
        points, triangles = halved(points, triangles)
        points /= np.linalg.norm(points, axis=1, keepdims=True)
    return wf.TriMesh(radius * points + center, triangles)


def sheet(cells=4, half=0.3, height=-0.002, shape=None):
    """A square about the origin, of cells x cells squares."""
    g = np.linspace(-half, half, cells + 1)
    points = np.array([(x, y, height if shape is None else shape(x, y)) for y in g for x in g])
    n = cells + 1
    i = np.arange(n * n).reshape(n, n)[:-1, :-1].ravel()
    return points, np.concatenate([np.column_stack([i, i + 1, i + n + 1]), np.column_stack([i, i + n + 1, i + n])])


def dented():
    """A closed mesh with ridges, valleys and a saddle."""
    points, triangles = octahedron()
    for _ in range(3):
        points, triangles = halved(points, triangles)
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return wf.TriMesh((1.0 + 0.4 * np.prod(np.sin(3.0 * points), axis=1))[:, None] * points, triangles)


# the search, beside brute force


@functools.cache
def probing():
    """A kernel that calls the device functions, and the collider's struct."""
    f, Contacts = collider_functions(True), contact_struct(True)
    distance, sweep = f.distance, f.sweep

    @wp.kernel(module="unique", enable_backward=False)
    def probe(
        con: Contacts, k: int, a: wp.array(dtype=wp.vec3d), b: wp.array(dtype=wp.vec3d), side: wp.array(dtype=int),
        gap: wp.array(dtype=wp.vec4d), swept: wp.array(dtype=int),
    ):  # fmt: skip
        i = wp.tid()
        gap[i] = distance(con, k, b[i], side[i])
        swept[i] = sweep(con, k, a[i], b[i], side[i])

    return probe, Contacts


class Model:
    """As much of a model as tables need."""

    def __init__(self, device):
        self.device = device

    def array(self, _, values, dtype):
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self.device)


def search(mesh, ends, starts=None, sides=None, others=(), device="cpu"):
    """Normals, gaps and swept sides of places in the world; `others`: meshes before and after it in the tables."""
    probe, Contacts = probing()
    shapes = [*others, mesh, *others]
    con, k = Contacts(), len(others)
    con.mesh = mesh_tables(Model(device), shapes)
    con.kind = wp.array([s.kind for s in shapes], dtype=wp.int32, device=device)
    con.size = wp.array([s.sizes for s in shapes], dtype=wp.vec3d, device=device)
    center = mesh.frame()[0]
    count = len(ends)
    a, b = (
        wp.array(np.asarray(x) - center, dtype=wp.vec3d, device=device)
        for x in (ends if starts is None else starts, ends)
    )
    side = wp.array(np.full(count, -1) if sides is None else sides, dtype=wp.int32, device=device)
    gap, swept = wp.zeros(count, dtype=wp.vec4d, device=device), wp.zeros(count, dtype=wp.int32, device=device)
    Launcher(wp.get_device(device))(probe, count, [con, k, a, b, side, gap, swept])
    return gap.numpy()[:, :3], gap.numpy()[:, 3], swept.numpy()


def brute(mesh, places):
    """Distances (n,) and nearest places (n, 3), by projection on each face, each edge and each corner."""
    p = mesh.points[mesh.triangles]
    candidates = [np.broadcast_to(corner, (len(places), *corner.shape)) for corner in np.moveaxis(p, 1, 0)]
    y = places[:, None]
    for k in range(3):
        a, d = p[:, k], p[:, (k + 1) % 3] - p[:, k]
        t = np.clip(((y - a) * d).sum(axis=2) / (d**2).sum(axis=1), 0.0, 1.0)
        candidates.append(a + t[:, :, None] * d)
    u, v = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    gram = np.stack(
        [np.stack([(u * u).sum(1), (u * v).sum(1)], -1), np.stack([(u * v).sum(1), (v * v).sum(1)], -1)], -2
    )
    right = np.stack([((y - p[:, 0]) * u).sum(2), ((y - p[:, 0]) * v).sum(2)], -1)
    st = np.einsum("tij,ntj->nti", np.linalg.inv(gram), right)
    inside = (st >= 0.0).all(axis=2) & (st.sum(axis=2) <= 1.0)
    face = p[:, 0] + st[:, :, :1] * u + st[:, :, 1:] * v
    candidates.append(np.where(inside[:, :, None], face, np.inf))
    every = np.concatenate(candidates, axis=1)
    square = ((every - y) ** 2).sum(axis=2)
    best = square.argmin(axis=1)
    return np.sqrt(square[np.arange(len(places)), best]), every[np.arange(len(places)), best]


def winding(mesh, places):
    """Times that a closed mesh runs around each place (van Oosterom and Strackee 1983)."""
    a, b, c = (mesh.points[mesh.triangles[:, k]] - places[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=2) for x in (a, b, c))
    over = (a * np.cross(b, c)).sum(axis=2)
    under = la * lb * lc + (a * b).sum(2) * lc + (b * c).sum(2) * la + (c * a).sum(2) * lb
    return np.arctan2(over, under).sum(axis=1) / (2.0 * np.pi)


def blade():
    """An octahedron with edges of 17 degrees and needle tips."""
    points, triangles = octahedron()
    return wf.TriMesh(points * (1.0, 0.15, 1.0), triangles)


CLOSED = {
    "box": lambda: boxed(cells=4),
    "octahedron": lambda: wf.TriMesh(*octahedron()),
    "dented": dented,
    "blade": blade,
}


@pytest.mark.parametrize("name", CLOSED)
def test_nearest_places_and_sides_of_closed_meshes(name):
    mesh = CLOSED[name]()
    center, size = mesh.frame()[0], mesh.sizes[0]
    places = center + 0.7 * np.ptp(mesh.points, axis=0) * np.random.default_rng(3).uniform(-1, 1, (500, 3))
    normal, gap, _ = search(mesh, places, others=(ball(1.0, (0, 0, 0), 1),))
    wanted, near = brute(mesh, places)
    inside = winding(mesh, places) > 0.5
    assert 20 < inside.sum() < 400
    assert np.abs(np.abs(gap) - wanted).max() < 1e-14 * size
    assert ((gap < 0.0) == inside).all()
    assert np.abs(places - gap[:, None] * normal - near).max() < 1e-13 * size


@pytest.mark.cuda
def test_a_deep_tree_is_searched_alike_on_cuda():
    mesh = ball(1.0, (0, 0, 0), 7)
    rng = np.random.default_rng(2).normal(size=(5000, 3))
    ends = rng * (np.linspace(0.5, 2.0, 5000) / np.linalg.norm(rng, axis=1))[:, None]
    starts = 1.3 * ends
    host, device = (search(mesh, ends, starts, device=d) for d in ("cpu", "cuda:0"))
    assert np.abs(device[1] - host[1]).max() < 1e-14
    assert (device[2] == host[2]).mean() > 0.999  # on a border either triangle may be met first


def test_places_over_edges_and_corners_are_told_in_or_out():
    """Where several triangles are equally near, a face's own normal may say the wrong side."""
    for mesh in (wf.TriMesh(*octahedron()), dented(), boxed(), blade()):
        p = mesh.points[mesh.triangles]
        middles = 0.5 * (p + np.roll(p, 1, axis=1)).reshape(-1, 3)
        at = np.concatenate([middles, p.reshape(-1, 3)])
        step = np.random.default_rng(5).normal(size=at.shape)
        places = at + 1e-3 * step / np.linalg.norm(step, axis=1, keepdims=True)
        _, gap, _ = search(mesh, places)
        assert ((gap < 0.0) == (winding(mesh, places) > 0.5)).all()


def test_a_sheet_is_felt_from_both_sides():
    mesh = wf.TriMesh(*sheet(height=0.0))
    normal, gap, _ = search(mesh, np.array([(0.1, 0.05, 0.2), (0.1, 0.05, -0.2), (0.4, 0, -0.1), (0.4, 0.0, 0.1)]))
    far = math.hypot(0.1, 0.1)
    assert gap == pytest.approx([0.2, 0.2, far, far], rel=1e-14)
    root = math.sqrt(0.5)
    np.testing.assert_allclose(normal, [(0, 0, 1), (0, 0, -1), (root, 0, -root), (root, 0, root)], atol=1e-13)


def test_motions_through_a_sheet_are_seen():
    mesh = wf.TriMesh(*sheet(height=0.0))
    rng = np.random.default_rng(7)
    a, b = (np.column_stack([rng.uniform(-0.29, 0.29, (300, 2)), z * rng.uniform(1e-9, 0.8, 300)]) for z in (1, -1))
    grid = np.linspace(-0.3, 0.3, 5)[1:-1]
    corners = np.array([(x, y, 0.0) for x in grid for y in grid])  # through corners of triangles
    a, b = (
        np.concatenate([a, corners + (0, 0, 0.3), corners]),
        np.concatenate([b, corners - (0, 0, 0.3), corners - (0, 0, 0.5)]),
    )
    for start, end, behind in ((a, b, 0), (b, a, 1)):
        _, _, side = search(mesh, end, start)
        starts_on_it = start[:, 2] == 0.0
        crossing = ~(end[:, 2] == 0.0) if behind else np.ones(len(a), dtype=bool)
        assert (side[crossing & ~starts_on_it] % 2 == behind).all()
        assert (side[crossing] >= 0).all()
        normal, gap, _ = search(mesh, end, sides=side)
        assert gap[crossing] == pytest.approx(-np.abs(end[crossing, 2]), rel=1e-13, abs=1e-16)
        assert normal[crossing, 2] == pytest.approx(1 - 2 * behind)
    away = np.array([(0.0, 0, 0.1), (1.0, 0, 0.1), (-1.0, 0.2, 0.5)])
    _, _, side = search(mesh, away + ((0, 0, 1), (0, 0, -1), (0, 0, -1)), away)
    assert (side == -1).all()


def test_a_point_that_rounding_has_put_beyond_a_sheet_is_where_it_was():
    mesh = wf.TriMesh(*sheet(height=0.0))
    start = np.array([(0.1, 0.02, -1e-8), (0.1, 0.02, 1e-8)])  # one was in front, one behind
    _, _, side = search(mesh, start + ((0, 0, -1e-3), (0, 0, 1e-3)), start, sides=[-3, -4])
    assert (side >= 0).all()
    assert (side % 2).tolist() == [0, 1]
    _, _, side = search(mesh, start + ((0, 0, 1e-3), (0, 0, -1e-3)), start, sides=[-3, -4])
    assert side.tolist() == [-1, -1]


def test_motions_through_a_plate_are_refused_and_those_over_its_edge_are_not():
    mesh = boxed(size=(1, 1, 0.02), center=(0, 0, -0.01), cells=8)
    start = np.array([(0.1, 0.1, 0.5), (0.1, 0.13, 0.5), (0.495, 0, 0.003), (0.499, 0.2, 0.02), (0.1, 0.1, 0.001)])
    end = np.array([(0.1, 0.2, -0.5), (0.1, 0.2, -0.015), (0.505, 0, -0.005), (0.6, 0.2, -0.1), (0.1, 0.1, -0.001)])
    _, _, side = search(mesh, end, start)
    assert side[0] == -2
    assert side[1] >= 0
    assert (side[2:4] == -1).all()
    assert side[4] >= 0
    _, gap, _ = search(mesh, end, sides=side)
    assert gap[1] == pytest.approx(-0.015)  # from the face that it came through, though the other is nearer
    _, _, further = search(mesh, np.array([(0.1, 0.2, -0.5), (0.1, 0.2, 0.1)]), end[[1, 1]], side[[1, 1]])
    assert further.tolist() == [-2, -1]


# contact


SLIDE = ([0, 0.01, 0.02, 0.05], [(0, 0, 0), (0, 0.01, 0.003), (0.01, 0, -0.002), (0.05, 0, 0)])
TURN = wf.Rotation(anchor=(0.05, 0.05, 0), axis=(0, 0.2, 1), angle=([0, 1], [0, 10.0]))


def thrown(shape, path=None, *, device="cpu", dtype="float64", worlds=1, speed=-0.3, E=1e6, **options):
    """A cube of 0.1 m and 1 kg that spins and slides onto an obstacle: cube, model."""
    b = wf.ModelBuilder()
    law = wf.SVK(E=E, nu=0.3, density=1000)
    cube = b.add_solid(wf.mesh.box((SIDE,) * 3, cells=(1, 1, 1)), material=law, name="cube")
    b.set_initial(cube, velocity=(1.0, 0.2, speed), angular_velocity=(0, 3, 5))
    floor = b.add_collider(shape, path=path, name="floor")
    b.add_contact(cube, floor, **({"mu": 0.5, "restitution": 0.5, "name": "pad"} | options))
    return cube, b.finalize(device=device, dtype=dtype, worlds=worlds)


def moved(steps, *args, dt=DT, integrator="backward_euler", **options):
    """Positions after some steps, and the simulation."""
    cube, model = thrown(*args, **options)
    sim = wf.Simulation(model, dt=dt, integrator=integrator)
    sim.step(steps)
    return sim.positions(cube), sim


BOX = wf.Box((0.05, 0.05, -0.102), (0.6, 0.6, 0.2))
MESHES = {"closed": lambda: boxed(cells=8), "sheet": lambda: wf.TriMesh(*sheet(7, 0.35))}


@pytest.mark.parametrize("path", [None, SLIDE, TURN], ids=["rests", "path", "rotation"])
@pytest.mark.parametrize("name", MESHES)
def test_flat_meshes_are_as_a_box(name, path):
    wanted, there = moved(30, BOX, path)
    found, here = moved(30, MESHES[name](), path)
    assert there.contact_record("pad").force[0, :, 2].max() > 5.0
    assert np.abs(found - wanted).max() < 1e-9 * SIDE
    one, other = (s.energies()["ledger_residual"][0] for s in (here, there))
    assert abs(one) < abs(other) + 1e-9
    assert here.contact_record("pad").force == pytest.approx(there.contact_record("pad").force, abs=1e-6)


@pytest.mark.parametrize(("law", "options"), [
    ("paper", {}), ("paper", {"treatment": "explicit"}), ("smooth", {}), ("default", {"offset": 0.0015}),
    ("default", {"model": "sphere", "radius": 0.05}),
])  # fmt: skip
def test_laws_and_options_are_those_of_a_box(law, options):
    wanted, _ = moved(15, BOX, law=law, **options)
    found, sim = moved(15, boxed(cells=8), law=law, **options)
    assert sim.contact_record("pad").normal_force.max() > 1.0
    assert np.abs(found - wanted).max() < 1e-9 * SIDE


def pressed(shape, down=0.004):
    """Forces on a cube whose top is driven down onto an obstacle by its own statics, N, and its positions."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    law = wf.SVK(E=1e6, nu=0.3, density=1000)
    cube = b.add_solid(wf.mesh.box((SIDE,) * 3, cells=(3, 3, 3)), material=law, name="cube")
    b.drive(cube.nodes("z+"), displacement=(0, 0, -down))
    b.add_contact(cube.surface("z-"), b.add_collider(shape), mu=0.2, stiffness=10.0, name="pad")
    sim = wf.solve_static(b.finalize(device="cpu"), load_steps=2).simulation
    return sim.contact_record("pad").force[0, -1], sim.positions(cube)[0]


def test_a_fine_ball_is_a_sphere_with_an_error_of_the_second_order():
    middle, radius = np.array([0.052, 0.047, -0.2]), 0.199
    force, place = pressed(wf.Sphere(middle, radius))
    assert force[2] > 10.0
    forces, places = zip(*(pressed(ball(radius, middle, n)) for n in (4, 5, 6, 7)))
    for errors in (
        np.abs(np.array(forces) - force)[:, 2] / force[2],
        np.abs(np.array(places) - place).max(axis=(1, 2)),
    ):
        assert errors[-1] < 3e-3
        assert np.log2(errors[0] / errors[-1]) / 3 > 1.85
    rng = np.random.default_rng(1).normal(size=(200, 3))
    around = middle + 0.2 * rng / np.linalg.norm(rng, axis=1, keepdims=True)
    gaps = np.array([np.abs(search(ball(radius, middle, n), around)[1] - 0.001).max() for n in (2, 3, 4, 5)])
    assert (np.log2(gaps[:-1] / gaps[1:]) > 1.8).all()


def rolled(shape, *, dtype="float64", spin=10.0, law="default", **options):
    """A soft ball that rolls, or slides, 12 mm along an obstacle, over borders 5 mm apart: its record and positions."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    mesh = wf.mesh.sphere(0.05, cells=2, center=(0, 0, 0.05))
    body = b.add_solid(mesh, material=wf.NeoHookean.from_E_nu(E=1e5, nu=0.3, density=1000.0), name="ball")
    b.set_initial(body, velocity=(0.5, 0.2, 0), angular_velocity=(-0.4 * spin, spin, 0))
    b.add_contact(body, b.add_collider(shape), mu=0.3, restitution=0.3, law=law, name="pad", **options)
    sim = wf.Simulation(b.finalize(device="cpu", dtype=dtype), dt=1e-3)
    sim.step(25)
    return sim.contact_record("pad"), sim.positions(body)[0]


@pytest.mark.parametrize(
    "options", [{}, {"spin": 0.0}, {"model": "sphere", "radius": 0.05}], ids=["rolls", "slides", "sphere"]
)
def test_borders_of_a_flat_mesh_are_not_felt(options):
    lumped = "model" in options
    mesh = boxed((0.32, 0.32, 0.1), (0.011, 0.007, -0.05), cells=64) if lumped else wf.TriMesh(*sheet(64, 0.16, 0.0))
    (on_mesh, place), (on_plane, wanted) = rolled(mesh, **options), rolled(wf.HalfSpace((0, 0, 1)), **options)
    normal = on_plane.normal_force[0]
    assert normal.max() > 1.0
    jump = np.abs(on_mesh.force - on_plane.force)[0, :, :2].max(axis=1)
    assert (jump <= 1e-3 * 0.3 * normal + 1e-12).all()
    assert jump.max() < 1e-6 * normal.max()  # it is far below
    assert (
        np.abs(on_mesh.force[0, :, 2] - on_mesh.normal_force[0]).max() < 1e-12 * normal.max()
    )  # normals are that of the plane
    assert np.abs(place - wanted).max() < 1e-9 * SIDE


@pytest.mark.parametrize("E", [1e6, 1e8])
@pytest.mark.parametrize("way", [-1.0, 1.0], ids=["down", "up"])
def test_a_sheet_is_not_passed_at_100_m_per_s(E, way):
    """From the front and from behind, ten sides of the cube in a step."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    mesh = wf.mesh.box((SIDE,) * 3, cells=(2, 2, 2))
    cube = b.add_solid(mesh, material=wf.SVK(E=E, nu=0.3, density=1000), name="cube")
    b.set_initial(cube, velocity=(0, 0, 100.0 * way))
    points, triangles = sheet(6, 0.5, height=0.3 if way > 0 else -0.2)
    b.add_contact(cube, b.add_collider(wf.TriMesh(points, triangles)), mu=0.3, restitution=0.5, name="pad")
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-2)
    if E == 1e6:  # an element of 50 mm is crushed
        with pytest.raises(wf.ConvergenceError, match="inside out"):
            sim.step(4)
    else:
        sim.step(4)
        assert way * sim.state.velocity.numpy()[0, :, 2].mean() < 0.0
    middle = sim.positions(cube)[0, :, 2].mean()
    assert middle < 0.3 if way > 0 else middle > -0.2


@pytest.mark.cuda
@pytest.mark.parametrize("name", MESHES)
def test_cuda_is_as_a_box_and_as_the_cpu(name):
    wanted, _ = moved(30, BOX, TURN)
    found, _ = moved(30, MESHES[name](), TURN, device="cuda:0")
    assert np.abs(found - wanted).max() < 1e-9 * SIDE


def test_float32_follows_float64():
    wanted, _ = moved(20, boxed(cells=4))
    found, sim = moved(20, boxed(cells=4), dtype="float32")
    assert sim.contact_record("pad").normal_force.max() > 5.0
    assert np.abs(found - wanted).max() < 1e-5 * SIDE


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda:0", marks=pytest.mark.cuda)])
def test_worlds_are_bit_equal_to_their_own_run(device):
    mesh = dented_floor()
    alone, _ = moved(20, mesh, device=device)
    together, sim = moved(20, mesh, worlds=3, device=device)
    assert sim.contact_record("pad").normal_force.max() > 5.0
    assert all((together[k] == alone[0]).all() for k in range(3))


def dented_floor(n=16):
    """A hilly sheet that the thrown cube lands on."""
    return wf.TriMesh(*sheet(n, 0.35, shape=lambda x, y: -0.004 + 0.002 * math.sin(30 * x) * math.cos(25 * y)))


def test_a_run_goes_on_from_a_checkpoint(tmp_path):
    whole, _ = moved(24, dented_floor(), TURN)
    _, sim = moved(14, dented_floor(), TURN)
    assert sim.contact_record("pad").normal_force[0, -1] > 0.0
    save_checkpoint(sim, tmp_path / "half.npz")
    cube, model = thrown(dented_floor(), TURN)
    again = wf.Simulation(model, dt=DT)
    again.resume(tmp_path / "half.npz")
    again.step(10)
    assert (again.positions(cube) == whole).all()
    _, other = thrown(wf.TriMesh(*sheet(16, 0.35, shape=lambda x, y: -0.004)), TURN)
    with pytest.raises(wf.CheckpointError):
        wf.Simulation(other, dt=DT).resume(tmp_path / "half.npz")


def test_energies_close_on_a_hilly_sheet_that_turns():
    _, sim = moved(40, dented_floor(), TURN, E=1e6)
    assert sim.contact_record("pad").normal_force.max() > 5.0
    assert abs(sim.energies()["ledger_residual"][0]) < 1e-6


def test_a_thin_plate_is_not_passed_either():
    """20 mm at 100 m/s and 1 m a step, as of a box."""
    places = []
    for shape in (wf.Box((0.05, 0.05, -0.21), (0.6, 0.6, 0.02)), boxed((0.6, 0.6, 0.02), (0.05, 0.05, -0.21), 4)):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        mesh = wf.mesh.box((SIDE,) * 3, cells=(2, 2, 2))
        cube = b.add_solid(mesh, material=wf.SVK(E=1e8, nu=0.3, density=1000), name="cube")
        b.set_initial(cube, velocity=(0, 0, -100.0))
        b.add_contact(cube, b.add_collider(shape), restitution=0.5, name="pad")
        sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-2)
        sim.step(4)
        places.append(sim.positions(cube)[0])
    assert places[0][:, 2].min() > -0.22
    assert np.abs(places[1] - places[0]).max() < 1e-6 * SIDE


def test_an_impact_beyond_the_penalty_is_a_penetration_error():
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    mesh = wf.mesh.box((SIDE,) * 3, cells=(2, 2, 2))
    cube = b.add_solid(mesh, material=wf.SVK(E=1e4, nu=0.3, density=1000), name="cube")
    b.set_initial(cube, velocity=(0, 0, -100.0))
    b.add_contact(cube, b.add_collider(wf.TriMesh(*sheet(6, 0.5, -0.2)), name="sheet"), name="pad")
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    with pytest.raises(wf.PenetrationError, match=r"'pad': a point of body 'cube' .* went through collider 'sheet'"):
        sim.step(10)
    assert sim.positions(cube)[0, :, 2].max() > -0.2


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("way", [-1.0, 1.0], ids=["front", "behind"])
def test_a_cube_bounces_on_either_side_of_a_sheet(way, dtype):
    """Pulled to it, with a corner ahead: points touch and part in every step; none is taken to the other side."""
    b = wf.ModelBuilder(gravity=(0, 0, 100.0 * way))
    turn = np.array([(1, 0, 0), (0, 0.8, -0.6), (0, 0.6, 0.8)])
    mesh = wf.mesh.box((SIDE,) * 3, cells=(1, 1, 1))
    body = b.add_solid(mesh, material=wf.SVK(E=1e6, nu=0.3, density=1000), transform=(turn, (0, 0, 0.0)), name="cube")
    height = body.mesh.points[:, 2].max() + 1e-3 if way > 0 else body.mesh.points[:, 2].min() - 1e-3
    b.add_contact(body, b.add_collider(wf.TriMesh(*sheet(6, 0.6, height))), mu=0.2, restitution=0.8, name="pad")
    sim = wf.Simulation(b.finalize(device="cpu", dtype=dtype), dt=1e-3)
    for _ in range(150):
        sim.step()
        assert way * sim.contact_force("pad")[0, 2] <= 0.0 or np.isnan(sim.contact_force("pad")).any()
    assert (sim.contact_record("pad").normal_force[0] > 1.0).sum() > 20
    assert way * (sim.positions(body)[0, :, 2].mean() - height) < 0.0


def placed(shape, height, turn=None):
    """A cube that rests with its lower corner at (0, 0, height): a simulation of it without gravity."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    transform = (np.eye(3) if turn is None else turn, (0, 0, height))
    mesh = wf.mesh.box((SIDE,) * 3, cells=(1, 1, 1))
    cube = b.add_solid(mesh, material=wf.SVK(E=1e6, nu=0.3, density=1000), transform=transform, name="cube")
    b.add_contact(cube, b.add_collider(shape, name="sheet"), name="pad")
    return wf.Simulation(b.finalize(device="cpu"), dt=DT)


@pytest.mark.parametrize("height", [-0.05, -1e-3, -0.0999, -SIDE])
def test_bodies_that_begin_across_a_sheet_are_refused(height):
    with pytest.raises(
        wf.ModelError, match=r"body 'cube' begins on both sides of collider 'sheet', or on it and behind"
    ):
        placed(wf.TriMesh(*sheet(6, 0.3, 0.0)), height)


@pytest.mark.parametrize("height", [0.0, 1e-6, -SIDE - 1e-6])
def test_bodies_beside_a_sheet_begin(height):
    c, s = math.cos(0.3), math.sin(0.3)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0, 0, 1.0]])
    for sim in (placed(wf.TriMesh(*sheet(6, 0.3, 0.0)), height), placed(wf.TriMesh(*sheet(6, 0.3, 0.0)), height, turn)):
        sim.step(3)
        assert np.abs(sim.state.velocity.numpy()).max() < 1e-12


def test_bodies_inside_of_a_closed_mesh_are_refused_or_pushed_out():
    mesh = boxed((0.6, 0.6, 0.2), (0.05, 0.05, -0.09))
    with pytest.raises(wf.ModelError, match=r"begins 0\.01 m inside collider 'floor'"):
        moved(1, mesh)
    wanted, _ = moved(30, wf.Box((0.05, 0.05, -0.09), (0.6, 0.6, 0.2)), overlap="offset", overlap_time=0.02)
    found, _ = moved(30, mesh, overlap="offset", overlap_time=0.02)
    assert np.abs(found - wanted).max() < 1e-9 * SIDE


# bad input


def point_meshes():
    points, triangles = octahedron()
    extra = np.array([(0, 1, 5)])
    turned = triangles.copy()
    turned[2] = turned[2][::-1]
    third = np.concatenate([points, [(3.0, 3.0, 0.0)]])
    nan = points.copy()
    nan[4, 1] = np.nan
    return {
        "none": (points, np.zeros((0, 3), dtype=int), "there are no triangles"),
        "nothing": (points, None, "there are no triangles"),
        "quads": (points, [(0, 1, 2, 3)], r"triangles have shape \(1, 4\)"),
        "fractions": (points, [(0.0, 1.0, 2.0)], "type float64, expected"),
        "flat points": (points[:, :2], triangles, r"points have shape \(6, 2\)"),
        "words": ([("a", "b", "c")], triangles, "must be"),
        "range": (points, [(0, 1, 6)], r"triangle 0 = \[0, 1, 6\] has a point number out of range, 0 \.\. 5"),
        "negative": (points, [(0, 1, -1)], "out of range"),
        "nan": (nan, triangles, r"point 4 = \[.*nan.*\] is not finite"),
        "degenerate": (points, [(0, 1, 2), (0, 1, 0)], r"triangle 1 = \[0, 1, 0\] has no area"),
        "in a line": ([(0, 0, 0), (1, 0, 0), (3, 0, 0)], [(0, 1, 2)], "triangle 0 .* has no area"),
        "orientation": (
            points,
            turned,
            r"points \d and \d is run through in one direction by triangles",
        ),
        "three": (
            third,
            [(0, 1, 2), (1, 0, 5), (0, 1, 6)],
            "points 0 and 1 has more than two triangles",
        ),
        "inside out": (points, triangles[:, ::-1], r"closed and inside out, its volume is -1\.33 m\^3"),
        "folded": ([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 2, 0)], [(0, 1, 2), (1, 0, 3)], "folds back on itself"),
        "many": (points, np.concatenate([triangles, extra]), "more than two triangles"),
    }


@pytest.mark.parametrize("name", point_meshes())
def test_bad_meshes_are_named(name):
    points, triangles, message = point_meshes()[name]
    with pytest.raises(wf.ModelError, match="^TriMesh: .*" + message):
        wf.TriMesh(points, triangles)


@pytest.mark.parametrize("scale", [0.0, -1.0, math.nan, "big"])
def test_bad_scales_are_named(scale):
    with pytest.raises(wf.ModelError, match="TriMesh: scale = "):
        wf.TriMesh(*octahedron(), scale=scale)


def test_a_lumped_contact_needs_an_inside():
    with pytest.raises(wf.ModelError, match="collider 'floor' is a sheet of triangles, and model = 'sphere'"):
        thrown(wf.TriMesh(*sheet()), model="sphere", radius=0.05)


@pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply", ".vtk", ".vtu"])
def test_files(tmp_path, suffix):
    meshio = pytest.importorskip("meshio")
    points, triangles = octahedron()
    file = tmp_path / f"rock{suffix}"
    meshio.Mesh(points, [("triangle", triangles)]).write(file)
    mesh = wf.TriMesh(file, scale=1e-3)
    assert mesh.closed
    assert mesh.volume == pytest.approx(4.0 / 3.0 * 1e-9, rel=1e-6)
    assert len(mesh.triangles) == 8


def test_bad_files_are_named(tmp_path):
    meshio = pytest.importorskip("meshio")
    with pytest.raises(wf.ModelError, match=r"TriMesh: .*none\.stl: no such mesh file"):
        wf.TriMesh(tmp_path / "none.stl")
    (tmp_path / "bad.vtu").write_text("nothing")
    with pytest.raises(wf.ModelError, match=r"TriMesh: .*bad\.vtu: can't be read"):
        wf.TriMesh(str(tmp_path / "bad.vtu"))
    meshio.Mesh(np.eye(3), [("line", [[0, 1]])]).write(tmp_path / "line.vtk")
    with pytest.raises(wf.ModelError, match=r"has no triangles, but line"):
        wf.TriMesh(tmp_path / "line.vtk")
    with pytest.raises(wf.ModelError, match="triangles = must be left out"):
        wf.TriMesh(tmp_path / "line.vtk", [(0, 1, 2)])
    meshio.Mesh(sheet(2)[0], [("quad", [[0, 1, 4, 3]])]).write(tmp_path / "quad.vtk")
    assert len(wf.TriMesh(tmp_path / "quad.vtk").triangles) == 2


def test_corners_in_one_place_are_one():
    """As files hold them that tell each triangle's corners: the mesh is closed all the same."""
    points, triangles = octahedron()
    mesh = wf.TriMesh(points[triangles].reshape(-1, 3), np.arange(24).reshape(8, 3))
    assert mesh.closed
    assert mesh.volume == pytest.approx(4.0 / 3.0)


# what is shown, and what it costs


def test_writers_draw_it_where_it_is(tmp_path):
    from pxr import Usd, UsdGeom

    cube, model = thrown(boxed(cells=2), TURN)
    sim = wf.Simulation(model, dt=DT)
    path = tmp_path / "mesh.usda"
    sim.run(0.004, outputs=[wf.USDWriter(path, fps=500.0), wf.VTUWriter(tmp_path / "vtu", every=2)])
    stage = Usd.Stage.Open(str(path))
    prim = stage.GetPrimAtPath("/World/world_0000/floor/shape")
    drawn = UsdGeom.Mesh(prim)
    assert prim.GetCustomDataByKey("warpfea:collider") == "TriMesh"
    assert len(drawn.GetFaceVertexCountsAttr().Get()) == 48
    last = stage.GetEndTimeCode()
    matrix = np.array(UsdGeom.XformCache(last).GetLocalToWorldTransform(prim))
    points = np.asarray(drawn.GetPointsAttr().Get(last)) @ matrix[:3, :3] + matrix[3, :3]
    place, turn, _ = sim.collider_poses()
    shape = model.description.colliders[0].shape
    wanted = (shape.points - shape.frame()[0]) @ turn[0, 0].T + place[0, 0]
    assert np.abs(points[:, None] - wanted).max(axis=2).min(axis=1).max() < 1e-6
    assert np.abs(turn[0, 0] - np.eye(3)).max() > 0.01
    assert (tmp_path / "vtu" / "vtu_colliders.pvd").exists()


def test_a_surface_that_lies_further_out():
    """`model.set_parameter("floor.offset", ...)` moves it along its normals, and its picture with it."""
    wanted, found = [], []
    for shape, out in ((BOX, wanted), (boxed(cells=4), found)):
        cube, model = thrown(shape)
        model.set_parameter("floor.offset", 0.0015)
        sim = wf.Simulation(model, dt=DT)
        sim.step(15)
        out += [
            sim.positions(cube),
            np.sort(Obstacles(sim, np.zeros(3), np.full(3, SIDE)).points()[0][0, :, 2])[[0, -1]],
        ]
    assert np.abs(found[0] - wanted[0]).max() < 1e-9 * SIDE
    np.testing.assert_allclose(found[1], wanted[1], atol=1e-12)


def test_info_counts_triangles(capfd, tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text(
        "import numpy as np, warpfea as wf\n"
        "@wf.scene(dt=1e-3, t_end=0.01)\n"
        "def drop():\n"
        "    b = wf.ModelBuilder()\n"
        "    law = wf.SVK(E=1e6, nu=.3, density=1000)\n"
        "    cube = b.add_solid(wf.mesh.box((.1,) * 3, cells=(1, 1, 1)), material=law, name='cube')\n"
        "    rock = wf.TriMesh(*wf.Box((.05, .05, -.1), (1, 1, .2)).mesh())\n"
        "    b.add_contact(cube, b.add_collider(rock), name='pad')\n"
        "    return b\n"
    )
    monkeypatch.chdir(tmp_path)
    capfd.readouterr()
    assert main(["info", "mine.py:drop", "--device", "cpu"]) == 0
    out = capfd.readouterr().out
    assert "body cube on mesh (12 triangles), law default, patch" in out
    assert "contact_float64_meshes" in out


def test_a_scene_without_a_mesh_has_nothing_of_it():
    names = {}
    for name, shape in (("box", BOX), ("closed", boxed()), ("sheet", wf.TriMesh(*sheet()))):
        sim = moved(2, shape)[1]
        names[name] = {module.name.rpartition(".")[2] for module in sim.stepper.modules()}
        assert hasattr(sim.model.terms.contact.tables.data, "mesh") == (name != "box")
    assert not any("meshes" in module for module in names["box"])
    assert {m.replace("_meshes", "") for m in names["closed"]} == names["box"]
    assert names["sheet"] == names["closed"]


def test_no_search_goes_over_all_triangles():
    """64 times as many triangles cost far less than 8 times the time; the machine may be busy."""
    rng = np.random.default_rng(1).normal(size=(20000, 3))
    around = 1.001 * rng / np.linalg.norm(rng, axis=1, keepdims=True)
    small, large = (seconds(ball(1.0, (0, 0, 0), halvings), around) for halvings in (3, 6))
    assert large < 8.0 * small, (small, large)


def seconds(mesh, places):
    """Least of a few times of a search, less that of what surrounds it."""
    mesh.tables  # noqa: B018

    def once(count):
        start = time.perf_counter()
        search(mesh, places[:count], places[:count] * 1.001)
        return time.perf_counter() - start

    return min(once(len(places)) for _ in range(4)) - min(once(1) for _ in range(4))
