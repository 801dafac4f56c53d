"""Gradients through contact and friction: against differences and closed forms; what is refused, what is counted."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from contact_cubes import cube, everywhere
from gradient_models import LAW, SOLVER, TARGET, best_differences, shifts
from triangle_meshes import Model
from warpfea.kernels.contact.collider_adjoint import normal_derivatives
from warpfea.kernels.contact.colliders import collider_functions
from warpfea.kernels.contact.structs import collider_struct

import warpfea as wf
from warpfea.contact.collider_tables import upload_collider_meshes
from warpfea.contact.tables import hunt_crossley_damping, restitution_beta, restitution_slopes
from warpfea.simulation.adjoint import check_terms

TOLERANCE = 1e-6  # the bar is 1e-5
SHARE = 0.1  # of the lengths of differences: beyond, other points stick
GAP = 2e-5
FAR = wf.HalfSpace((0, 0, 1), -1.0)
TETRAHEDRON = wf.TriMesh([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])
SHAPES = {
    "sphere": wf.Sphere((0, 0, 0), 0.7),
    "capsule": wf.Capsule((0, 0, -0.4), (0, 0, 0.4), 0.5),
    "box": wf.Box((0, 0, 0), (1.0, 0.8, 1.2)),
    "cylinder": wf.Cylinder((0, 0, -0.4), (0, 0, 0.4), 0.5),
    "tetrahedron": TETRAHEDRON,
}


@wp.kernel(enable_backward=False, module="unique")
def normals(
    col: collider_struct(True), y: wp.array(dtype=wp.vec3d), normal: wp.array(dtype=wp.vec4d),
    derivative: wp.array(dtype=wp.mat33d),
):  # fmt: skip
    i = wp.tid()
    normal[i] = distance(col, 0, y[i], -1)
    derivative[i] = normal_derivative(col, 0, y[i], -1)


distance, normal_derivative = collider_functions(True).distance, normal_derivatives(True).normal_derivative


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_normals_of_colliders_have_their_derivatives(shape):
    """Against differences, beside faces, edges, corners and rims, outside and inside."""
    rng = np.random.default_rng(0)
    y = rng.uniform(-1.0, 1.2, (200, 3))
    steps = 1e-5 * np.array([-2.0, -1.0, 1.0, 2.0])
    every = y[:, None, None, :] + steps[:, None, None] * np.eye(3)
    col = collider_struct(True)()
    col.mesh = upload_collider_meshes(Model("cpu"), [TETRAHEDRON])
    col.kind = wp.array([shape.kind], dtype=wp.int32, device="cpu")
    col.size = wp.array([shape.sizes], dtype=wp.vec3d, device="cpu")
    at = wp.array(np.concatenate([y, every.reshape(-1, 3)]), dtype=wp.vec3d, device="cpu")
    n, B = wp.zeros(len(at), dtype=wp.vec4d, device="cpu"), wp.zeros(len(at), dtype=wp.mat33d, device="cpu")
    wp.launch(normals, len(at), [col, at], [n, B], device="cpu")
    near = n.numpy()[len(y) :, :3].reshape(len(y), 4, 3, 3)
    wanted = np.einsum("k,pkjc->pcj", np.array([1.0, -8.0, 8.0, -1.0]) / 12e-5, near)
    errors = np.abs(B.numpy()[: len(y)] - wanted).max(axis=(1, 2)) / (1.0 + np.abs(wanted).max(axis=(1, 2)))
    assert (errors < 1e-6).mean() > 0.98  # else a position within 2e-5 of a border of two features
    assert np.abs(B.numpy()).max() > 0.5 or shape.kind == wf.Box.kind


def test_slopes_of_restitution():
    e = np.array([0.05, 0.3, 0.6, 0.9, 1.0])
    near = [
        [np.array([f(x + k * 1e-4) for x in e[:4]]) for k in (-2, -1, 1, 2)]
        for f in (hunt_crossley_damping, restitution_beta)
    ]
    damping, beta = (np.array([f(x) for x in e]) for f in (hunt_crossley_damping, restitution_beta))
    for found, values in zip(restitution_slopes(damping, beta), near):
        assert found[:4] == pytest.approx(np.array([1.0, -8.0, 8.0, -1.0]) @ values / 12e-4, rel=1e-7)
    assert restitution_slopes(damping, beta)[0][4] == -1.5
    assert np.isnan(restitution_slopes(np.array([-1.0]), np.array([1.0]))).all()


def thrown(worlds, shapes, paths, device="cpu", **options):
    """A soft cube that touches obstacles, on paths by their names."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    mesh = wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1), element="T4")
    box = b.add_solid(mesh, material=LAW, name="box")
    for name, (shape, side) in shapes.items():
        collider = b.add_collider(shape, name=name, path=paths.get(name))
        b.add_contact(box.surface(side), collider, mu=0.3, restitution=0.5, name=f"pad {name}", **options)
    b.add_probe("top", box.surface("z+"))
    return b.finalize(device=device, worlds=worlds)


FLOOR = wf.HalfSpace((0, 0, 1), -GAP), "z-"
BOX = wf.Box((-0.1 - GAP, 0.05, -0.9), (0.2, 2.0, 2.0)), "x-"
BALL = wf.Sphere((-0.3 - GAP, 0.053, 0.048), 0.3), "x-"
LOW = wf.HalfSpace((0, 0, 1), -3.5e-3), "z-"
GROUND = wf.Box((0.4, 0, -0.25 - GAP), (2.0, 2.0, 0.5)), "z-"
WALL = wf.Box((-0.1 - GAP, 0.05, 0.15 - GAP), (0.2, 1.0, 0.3)), "x-"
TURNING = ("floor", "ball")
RUNS = {  # shapes, velocity, steps, dt, integrator
    "slip and stick": ({"floor": FLOOR, "beside": BOX}, (-0.1, 0.02, -0.1), 8, 5e-4, "backward_euler"),
    "stick at once": ({"floor": FLOOR}, (-0.02, 0.01, -0.1), 3, 5e-4, "backward_euler"),
    "round": ({"ball": BALL}, (-0.1, 0.05, 0.02), 6, 5e-4, "backward_euler"),
    "seam": ({"ground": GROUND, "beside": WALL}, (-0.1, 0.02, -0.1), 8, 5e-4, "backward_euler"),
    "halved": ({"floor": FLOOR}, (0.3, 0.1, -0.1), 3, 1e-3, "backward_euler"),
    "impact": ({"floor": LOW}, (0.3, 0.1, -0.1), 5, 1e-2, "bdf2"),
}


def contact_run(kind, rows=None, worlds=slice(None), device="cpu"):
    """Tape of worlds whose parameters differ by rows; names, values at the base and, as one more, the controls."""
    shapes, velocity, steps, dt, integrator = RUNS[kind]
    names = {"box.E": 1e6, "box.nu": 0.3, "box.density": 1000.0, "gravity": np.array([1.0, 0.5, -9.81])}
    for name in shapes:
        names |= {
            f"pad {name}.{key}": value for key, value in {"mu": 0.3, "stiffness": 1.0, "restitution": 0.5}.items()
        }
        names[f"{name}.offset"] = 2e-6
    turning = {"anchor": (0.02, 0.01, -0.03), "axis": (0.3, 0.5, 0.8)}
    laws, controls = {}, {}
    if kind == "halved":  # by more than a radian in a step
        laws["floor"] = wf.Rotation(anchor=(0.03, 0.04, 0), axis=(0, 0, 1), angle=([0, 1], [0, 1500]))
    elif kind != "seam":  # obstacles with paths of their own have none
        controls = {name: (f"turn {name}", 1) if name in TURNING else (f"shift {name}", 3) for name in shapes}
        for name, (control, size) in controls.items():
            law = wf.Control(control, size)
            laws[name] = wf.Rotation(**turning, angle=law) if size == 1 else law
    rng = np.random.default_rng(0)
    paths = {name: 1e-5 * np.cumsum(rng.standard_normal((steps, size)), axis=0) for name, size in controls.values()}
    rows = SHARE * shifts(len(names) + len(paths)) if rows is None else rows
    mine = rows[worlds]
    m = thrown(len(mine), shapes, laws, device, seam=None if kind == "seam" else 0.0)
    for k, (name, value) in enumerate(names.items()):
        if name == "gravity":
            m.set_gravity(value * (1.0 + mine[:, k : k + 1]))
        else:
            level = shapes["floor"][0].offset if name == "floor.offset" else 0.0
            base = level if name.endswith("offset") else value
            m.set_parameter(name, base + value * mine[:, k])
    sim = wf.Simulation(m, dt=dt, solver=SOLVER, integrator=integrator)
    sim.state.velocity.assign(np.tile(velocity, (m.worlds, m.slots, 1)))
    tape = wf.Adjoint(sim, [*names, *paths, "initial.velocity"])
    slips, impacts = [], []
    for step in range(steps):
        for k, (name, values) in enumerate(paths.items(), len(names)):
            sim.controls[name][:] = values[step] * (1.0 + mine[:, k : k + 1])
        tape.run(1)
        slips.append((sim.state.contact_contact_state.numpy()[0] >= 1 << 30).sum())
        impacts += [sim.stepper.work.step.impact.numpy()[0]] if integrator == "bdf2" else []
    loss = wf.loss.sum_of_squares(tape.probe("top").displacement, np.full((1, steps, 3), TARGET))
    g = tape.backward(loss)
    exact = [SHARE * np.sum(g[name].numpy()[0] * value) for name, value in (names | paths).items()]
    return tape, loss, g, exact, rows, slips, impacts


@pytest.mark.parametrize("kind", [pytest.param(kind, marks=[pytest.mark.slow] * (kind == "seam")) for kind in RUNS])
def test_gradients_through_contact(kind):
    tape, loss, g, exact, rows, slips, impacts = contact_run(kind)
    errors = best_differences(loss.numpy(), exact)
    assert (errors < TOLERANCE).all(), errors
    assert (tape.residual < 1e-10).all()
    assert max(slips) > 0
    assert slips[0] == 0 or kind != "stick at once"
    if kind != "slip and stick":
        assert len(tape.kept) == (2 if kind == "halved" else 1) * tape.steps + 1
        assert any(impacts) == (kind == "impact")  # a step taken again with backward Euler
        assert (tape.model.terms.contacts[0].tables.seams is not None) == (kind == "seam")
        if kind == "impact":  # beside a world that takes more attempts, and fails
            two = np.zeros((2, rows.shape[1]))
            two[1, 3] = 300.0
            _, _, beside, *_ = contact_run(kind, two)
            assert all(np.array_equal(beside[name].numpy()[0], g[name].numpy()[0]) for name in g)
        return
    touching = (tape.sim.state.contact_speed.numpy()[0] > 0.0).sum()
    assert 0 < slips[-1] < touching - 4  # some stick
    assert g.switches[0] >= touching + slips[0] - slips[-1]
    _, _, alone, *_ = contact_run(kind, rows, slice(7, 8))
    assert all(np.array_equal(alone[name].numpy()[0], g[name].numpy()[7]) for name in g)
    assert alone.switches[0] == g.switches[7]


BODIES = {
    "slide": ("T4", (10.0, 3.0, -0.1), 10),  # over several facets
    "stick": ("T10", (0.05, 0.0, -0.1), 4),  # some points
}


def body_run(kind, rows, device="cpu"):
    """Tape of a cube on a slab in worlds whose parameters differ by rows; the derivatives by these."""
    element, velocity, steps = BODIES[kind]
    names = {"low.E": 1e6, "top.nu": 0.3, "top.density": 1000.0, "gravity": np.array([1.0, 0.5, -9.81])}
    names |= {"pad.mu": 0.3, "pad.stiffness": 1.0, "pad.restitution": 0.5}
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    mesh = wf.mesh.box((0.3, 0.3, 0.1), cells=(2, 2, 1), element=element)
    low = b.add_solid(mesh, material=LAW, name="low")
    mesh = wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1), element=element)
    turn = np.array([[np.cos(0.1), -np.sin(0.1), 0], [np.sin(0.1), np.cos(0.1), 0], [0, 0, 1]])
    top = b.add_solid(mesh, material=LAW, name="top", transform=(turn, (0.07, 0.06, 0.1 + GAP)))
    b.clamp(low.nodes("z-"))
    b.add_contact(top.surface("z-"), low.surface("z+"), mu=0.3, restitution=0.5, name="pad")
    b.add_probe("tip", top.surface("z+"))
    m = b.finalize(device=device, worlds=len(rows))
    for k, (name, value) in enumerate(names.items()):
        if name == "gravity":
            m.set_gravity(value * (1.0 + rows[:, k : k + 1]))
        else:
            m.set_parameter(name, value * (1.0 + rows[:, k]))
    sim = wf.Simulation(m, dt=5e-4, solver=SOLVER)
    start = np.zeros((m.worlds, m.slots, 3))
    start[:, m.bodies[1].slot_range] = velocity * (1.0 + rows[:, -1:, None])
    sim.state.velocity.assign(start)
    tape = wf.Adjoint(sim, [*names, "initial.velocity"])
    tape.run(steps)
    loss = wf.loss.sum_of_squares(tape.probe("tip").displacement, np.full((1, steps, 3), TARGET))
    g = tape.backward(loss)
    exact = [np.sum(g[name].numpy()[0] * value) for name, value in names.items()]
    return tape, loss, g, [*exact, np.sum(g["initial.velocity"].numpy()[0] * start[0])]


@pytest.mark.slow
@pytest.mark.parametrize("kind", BODIES)
def test_gradients_through_contact_between_bodies(kind):
    tape, loss, g, exact = body_run(kind, SHARE * shifts(8))
    errors = best_differences(loss.numpy(), SHARE * np.array(exact))
    assert (errors < TOLERANCE).all(), errors
    assert (tape.residual < 1e-10).all()
    facets = [kept["pairs_facet"].numpy()[0] for kept in tape.kept[1:]]
    changed = sum(((old != new) & (old > 0) & (new > 0)).sum() for old, new in pairwise(facets))
    assert changed > 10 or kind == "stick"
    state = tape.sim.state
    slips = (state.pairs_contact_state.numpy()[0] >= 1 << 30).sum()
    assert 0 < slips <= (state.pairs_speed.numpy()[0] > 0.0).sum() - 3 * (kind == "stick")
    if kind == "slide":
        _, _, alone, _ = body_run(kind, SHARE * shifts(8)[7:8])
        assert all(np.array_equal(alone[name].numpy()[0], g[name].numpy()[7]) for name in g)


@pytest.mark.cuda
def test_gradients_through_contact_on_a_gpu():
    """Those of the CPU."""
    rows = np.zeros((3, 14))
    rows[:, 0] = 0.0, 1e-3, 2e-3
    found = [contact_run("slip and stick", rows, device=device) for device in ("cpu", "cuda:0")]
    for name, values in found[0][2].items():
        host = values.numpy()
        assert found[1][2][name].numpy() == pytest.approx(host, rel=1e-7, abs=1e-8 * np.abs(host).max()), name
    assert np.array_equal(found[0][2].switches, found[1][2].switches)
    found = [body_run("stick", SHARE * shifts(8)[:3], device) for device in ("cpu", "cuda:0")]
    for name, values in found[0][2].items():
        host = values.numpy()
        assert found[1][2][name].numpy() == pytest.approx(host, rel=1e-7, abs=1e-8 * np.abs(host).max()), name


def test_rebound():
    """A stiff cube rebounds with v = -e v0: the law makes the velocities of the scheme proportional to v0."""
    v0, n, h = 0.5, 100, 1e-4
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = cube(b, origin=(0, 0, 1e-9))
    b.drive(body.nodes(everywhere), displacement=(0, 0, 0), components="xy")
    b.add_contact(body.surface("z-"), b.add_collider(wf.HalfSpace((0, 0, 1))), restitution=0.6,
                  stiffness=("region", 1e-2), name="pad")  # fmt: skip
    b.add_probe("top", body.surface("z+"))
    m = b.finalize(device="cpu")
    sim = wf.Simulation(m, dt=h, solver=SOLVER, integrator="bdf2")
    sim.state.velocity.assign(np.tile((0, 0, -v0), (1, m.slots, 1)))
    tape = wf.Adjoint(sim, ["pad.restitution", "initial.velocity"])
    tape.run(n)
    probe, grad = tape.probe("top"), np.zeros((1, n, 3))
    grad[0, -1, 2] = 1.0
    probe.velocity.grad.assign(grad)
    g = tape.backward()
    v = probe.velocity.numpy()[0, -1, 2]
    assert g["initial.velocity"].numpy()[0, :, 2].sum() == pytest.approx(-v / v0, rel=1e-6)
    assert v == pytest.approx(0.6 * v0, rel=1e-2)
    assert g["pad.restitution"].numpy()[0] == pytest.approx(v0, rel=1e-2)
    touching = (m.terms.contacts[0].tables.area_fractions[0] > 0.0).sum()
    assert g.switches[0] == 2 * touching  # each comes into contact and leaves it


def test_friction_of_a_guided_block():
    """On its way along x at a fixed depth the normal force N is constant: x = v0 t - mu N h^2 n (n + 1) / (2 m)."""
    h, n, depth = 1e-3, 10, 2e-4
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = cube(b)
    b.drive(body.nodes(everywhere), displacement=(0, 0, -depth), components="yz")
    pad = b.add_contact(body.surface("z-"), b.add_collider(wf.HalfSpace((0, 0, 1))), mu=0.3, restitution=1.0,
                        stiffness=("region", 1e-2), overlap="offset", overlap_time=1e-12, name="pad")  # fmt: skip
    b.add_probe("face", body.surface("x+"))
    m = b.finalize(device="cpu")
    with pytest.warns(wf.ModelWarning, match="initial jump"):
        sim = wf.Simulation(m, dt=h, solver=SOLVER)
    sim.state.velocity.assign(np.tile((1.0, 0, 0), (1, m.slots, 1)))
    tape = wf.Adjoint(sim, ["pad.mu", "pad.stiffness"])
    tape.run(n)
    without = {*sim.stepper.launch.modules, *(module.name for module in sim.stepper.modules()), *sim.bytes()}
    assert not any("adjoint" in name for name in without)
    way = sim.contact_force(pad)[0, 2] * h**2 * n * (n + 1) / 2  # the mass is 1 kg
    grad = np.zeros((1, n, 3))
    grad[0, -1, 0] = 1.0
    tape.probe("face").position.grad.assign(grad)
    g = tape.backward()
    assert g["pad.mu"].numpy()[0] == pytest.approx(-way, rel=1e-5)  # it shears a little
    assert g["pad.stiffness"].numpy()[0] == pytest.approx(-0.3 * way / 1e-2, rel=1e-5)


def test_sag_of_a_block_on_the_floor():
    """All compliances are proportional to 1/E, that of contact too: d(sag)/dE = -sag/E where it is small."""
    b = wf.ModelBuilder(gravity=(0, 0, -1e-5))
    mesh = wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1), element="T4")
    box = b.add_solid(mesh, material=LAW, name="box")
    b.drive(box.nodes("z+"), displacement=(0, 0, 0), components="xy")
    b.add_contact(box.surface("z-"), b.add_collider(wf.HalfSpace((0, 0, 1))), mu=0.0, restitution=0.5, name="pad")
    b.add_probe("top", box.surface("z+"))
    result = wf.solve_static(b.finalize(device="cpu"), load_steps=1, tol=1e-12, stabilise=True)
    tape = wf.Adjoint(result, ["box.E", "gravity", "pad.stiffness"])
    sag = tape.probe("top").displacement.numpy()[0, 0, 2]
    tape.probe("top").displacement.grad.assign(np.array([[[0, 0, 1.0]]]))
    g = tape.backward()
    assert g["box.E"].numpy()[0] == pytest.approx(-sag / 1e6, rel=1e-6)
    assert g["gravity"].numpy()[0, 2] == pytest.approx(sag / -1e-5, rel=1e-6)
    assert 0.0 < g["pad.stiffness"].numpy()[0] < abs(sag)


def test_features_of_contact_without_an_adjoint_are_refused_by_name():
    def refused(match, inertia=True, midpoint=False, accelerated=False, obstacle=FAR, path=None, **options):
        b = wf.ModelBuilder()
        box = b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1), element="T4"), material=LAW)
        b.add_contact(box, b.add_collider(obstacle, path=path), restitution=0.5, **options)
        ctx = SimpleNamespace(inertia=inertia, midpoint=midpoint, accelerated=accelerated)
        with pytest.raises(wf.ModelError, match=match):
            check_terms(b.finalize(device="cpu"), ctx)

    refused("'contact' has no adjoint for contacts of model='sphere'", model="sphere", radius=0.1)
    refused("schemes with accelerations", accelerated=True)
    refused("mid-point schemes", midpoint=True)
    refused("friction in statics", inertia=False, mu=0.3)
    refused("treatment='explicit'", law="paper", treatment="explicit")
    b = wf.ModelBuilder()
    part = b.add_rigid(wf.Cylinder((0, -0.2, 0.1), (0, 0.2, 0.1), 0.1), density=1000.0)
    b.add_contact(part, b.add_collider(FAR), restitution=0.5)
    with pytest.raises(wf.ModelError, match="'contact' has no adjoint for rigid capsules and cylinders that roll"):
        check_terms(b.finalize(device="cpu"), SimpleNamespace(inertia=True, midpoint=False, accelerated=False))
    needle = wf.Box((0.03, 0.04, -1.0), (1e-3, 1e-3, 0.1))
    refused("'pairs' has no adjoint for obstacles .* that move", obstacle=needle, path=wf.Control("needle", 3))
    b = wf.ModelBuilder()
    two = [cube(b, name, origin=(0, 0, 0.2 * k)) for k, name in enumerate("ab")]
    b.add_contact(*two, restitution=0.5)
    with pytest.raises(wf.ModelError, match="'pairs' has no adjoint for sharp edges"):
        check_terms(b.finalize(device="cpu"), SimpleNamespace(inertia=True, midpoint=False, accelerated=False))
