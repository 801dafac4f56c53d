"""Triangle meshes of boxes, balls and sheets."""

import functools
import math

import numpy as np
import warp as wp
from warpfea.kernels.contact.colliders import collider_functions
from warpfea.kernels.contact.structs import collider_struct

import warpfea as wf
from warpfea.base.launch import Launcher
from warpfea.base.memory import Memory
from warpfea.contact.collider_tables import upload_collider_meshes

SIDE, DT = 0.1, 1e-3


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


@functools.cache
def probing():
    """A kernel that calls the device functions, and the collider's struct."""
    f, Colliders = collider_functions(True), collider_struct(True)
    distance, sweep = f.distance, f.sweep

    @wp.kernel(module="unique", enable_backward=False)
    def probe(
        con: Colliders, k: int, a: wp.array(dtype=wp.vec3d), b: wp.array(dtype=wp.vec3d), side: wp.array(dtype=int),
        gap: wp.array(dtype=wp.vec4d), swept: wp.array(dtype=int),
    ):  # fmt: skip
        i = wp.tid()
        gap[i] = distance(con, k, b[i], side[i])
        swept[i] = sweep(con, k, a[i], b[i], side[i])

    return probe, Colliders


class Model:
    """As much of a model as tables need."""

    def __init__(self, device):
        self.memory = Memory(device, None)


def search(mesh, ends, starts=None, sides=None, others=(), device="cpu"):
    """Normals, gaps and swept sides of places in the world; `others`: meshes before and after it in the tables."""
    probe, Colliders = probing()
    shapes = [*others, mesh, *others]
    con, k = Colliders(), len(others)
    con.mesh = upload_collider_meshes(Model(device), shapes)
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
