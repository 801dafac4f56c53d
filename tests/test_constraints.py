"""Constraints and joints: derivatives against differences, freedoms, reactions, conflicts, redundancy, welds."""

import numpy as np
import pytest
import scipy.sparse as sp
import warp as wp
from scipy.spatial.transform import Rotation as Turn

import warpfea as wf
from warpfea.model import assembly
from warpfea.model.assembly import rigid_modes
from warpfea.simulation.checkpoint import save_checkpoint

LAW = wf.SVK(E=1e7, nu=0.3, density=1000.0)
ANCHOR = np.array([1.0, 0.05, 0.1])
AXIS = np.array([0.3, -0.5, 0.8])
AXIS = AXIS / np.linalg.norm(AXIS)


def box(b, low, high, cells=(1, 1, 1), law=LAW, **options):
    low, high = np.array(low, float), np.array(high, float)
    mesh = wf.mesh.box(tuple(high - low), cells=cells)
    return b.add_solid(mesh, transform=(np.eye(3), low), material=law, **options)


def handles(kind, b, where):
    """A handle of each sort, on a body that ends (parent) or starts (child) near the anchor."""
    x = (0.0, 1.0) if where == "parent" else (1.0, 2.0)
    end = "x+" if where == "parent" else "x-"
    if kind == "ground":
        return wf.GROUND
    if kind.startswith("beam"):
        beam = b.add_beam(
            [(x[0], 0.05, 0.1), (x[1], 0.05, 0.1)], elements=1, section=wf.Rectangle(0.05, 0.04), normal=(0, 0, 1),
            material=LAW,
        )  # fmt: skip
        return beam.end if where == "parent" else beam.start
    if kind == "shell":
        grid = wf.mesh.grid((1, 0.1), cells=(1, 1))
        plate = b.add_shell(grid, thickness=0.02, material=LAW, transform=(np.eye(3), (x[0], 0.0, 0.1)))
        return plate.edge(end)
    if kind == "shell point":
        grid = wf.mesh.grid((1, 0.1), cells=(1, 1))
        plate = b.add_shell(grid, thickness=0.02, material=LAW, transform=(np.eye(3), (x[0], 0.0, 0.1)))
        return plate.at(tuple(ANCHOR))
    body = box(b, (x[0], 0, 0), (x[1], 0.1, 0.2))
    if kind == "surface":
        return body.surface(end)
    if kind == "nodes":
        return body.nodes(lambda X: np.abs(X[:, 0] - 1.0) < 0.6)
    return body.at(tuple(ANCHOR))


RANK = {"spherical": 3, "universal": 4, "revolute": 5, "cylindrical": 4, "translational": 5, "fixed": 6, "distance": 1}
PAIRS = [("ground", "surface"), ("surface", "nodes"), ("beam", "beam"), ("shell", "point"), ("ground", "beam")]
PAIRS += [("beam", "ground"), ("beam", "shell point"), ("ground", "shell")]


def joined(kind, pair, drive=None, axis=AXIS, **options):
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    parent, child = (handles(p, b, where) for p, where in zip(pair, ("parent", "child")))
    extra = {"axis": axis} if kind in ("universal", "revolute", "cylindrical", "translational") else {}
    if kind == "distance":
        if "ground" in pair:
            extra["anchor"] = (1.3, 0.4, 0.5)
        else:
            child = child.body.at(centre(child.body))
    else:
        extra["anchor"] = ANCHOR
    joint = b.add_joint(kind, parent=parent, child=child, drive=drive, **extra)
    return b.finalize(device="cpu", **options), joint


def centre(body):
    low, high = body.mesh.bounding_box()
    return tuple(0.5 * (np.asarray(low) + np.asarray(high)))


def places(model):
    """(slots, 3) slot values in space, of the reference."""
    position = (model.slot_kind == 0)[:, None]
    origin = np.concatenate([np.tile(b.origin, (b.slot_count, 1)) for b in model.bodies])
    return model.reference + position * origin, position


def moved(model, motions):
    """Displacements that carry each body by its rotation and translation (about the anchor)."""
    x, position = places(model)
    u = np.zeros_like(x)
    for body, (turn, shift) in zip(model.bodies, motions):
        rows = body.slots
        arm = x[rows] - position[rows] * ANCHOR
        u[rows] = turn.apply(arm) + position[rows] * (ANCHOR + shift) - x[rows]
    return u


def state_at(model, u):
    state = model.state()
    state.displacement.assign(np.tile(u, (model.worlds, 1, 1)))
    return state


CASES = [(kind, pair) for kind in RANK for pair in PAIRS]


def random_pose(model, rng, size=0.1):
    """A rigid motion of each body and a deformation on top."""
    u = moved(model, [(Turn.random(random_state=rng), rng.normal(size=3)) for _ in model.bodies])
    return u + size * rng.normal(size=u.shape)


@wp.func
def wave(t: wp.float64) -> wp.float64:
    return wp.float64(0.7) + wp.sin(t)


EXTRA = {
    "driven revolute": ("revolute", ("beam", "surface"), ([0, 1], [0.8, 2.0])),
    "driven revolute, ground child": ("revolute", ("surface", "ground"), wave),
    "driven translational": ("translational", ("surface", "beam"), ([0, 1], [0.3, 2.0])),
    "driven distance": ("distance", ("ground", "beam"), wave),
}


def by_hand(model, u):
    """dc/dq (rows, 3 slots) from the rows' definitions; right sides as the device has them."""
    target = model.evaluation.constraints(state_at(model, u))[2][0]
    J = np.zeros((model.constraints.count, model.slots, 3))
    for k, row in enumerate(model.constraints.rows):
        entries = [vector.entries() for vector in row.terms]
        a, b, a2 = (vector.value + e[1] @ u[e[0]] for vector, e in zip(row.terms, entries))
        s, c = np.sin(target[k]), np.cos(target[k])
        G = {0: (b, a, 0 * a), 1: (a / np.linalg.norm(a), 0 * a, 0 * a), 2: (-s * b, c * a2 - s * a, c * b)}[row.kind]
        for (slots, weights, _), g in zip(entries, G):
            np.add.at(J[k], slots, row.scale * (model.size if row.angular else 1.0) * np.outer(weights, g))
    return J.reshape(len(J), -1)


@pytest.mark.parametrize("case", [*CASES, *EXTRA], ids=str)
def test_jacobian_and_curvature_match_differences(case):
    kind, pair, drive = EXTRA.get(case) or (*case, None)
    model, _ = joined(kind, pair, drive)
    rng = np.random.default_rng(3)
    u = random_pose(model, rng)
    if case in EXTRA and kind == "revolute":
        u = 0.1 * rng.normal(size=u.shape)  # within a right angle of the drive, where the row is the sine
    lam = rng.normal(size=model.constraints.count)
    p = rng.normal(size=u.shape)
    J = model.constraint_jacobian(state_at(model, u))
    assert np.abs(J.toarray() - by_hand(model, u)).max() < 1e-13
    h = 1e-5
    ahead, behind = (state_at(model, u + k * h * p) for k in (1, -1))
    slope = (model.constraint_values(ahead) - model.constraint_values(behind))[0] / (2 * h)
    scale = np.abs(J @ p.ravel()).max()
    assert J @ p.ravel() == pytest.approx(slope, abs=1e-8 * scale)
    force = (model.constraint_jacobian(ahead) - model.constraint_jacobian(behind)).T @ lam / (2 * h)
    curvature = model.constraint_curvature(state_at(model, u), lam, p)[0].ravel()
    assert curvature == pytest.approx(force, abs=1e-8 * max(np.abs(force).max(), 1e-3))


def allowed(kind, pair):
    """A large motion of the child against the parent that the joint leaves free, about the anchor."""
    turn, shift = Turn.identity(), np.zeros(3)
    if kind == "spherical":
        turn = Turn.from_rotvec([0.4, 0.9, -0.5])
    elif kind == "universal":
        turn = None
    elif kind == "revolute":
        turn = Turn.from_rotvec(1.1 * AXIS)
    elif kind == "cylindrical":
        turn, shift = Turn.from_rotvec(1.1 * AXIS), 0.6 * AXIS
    elif kind == "translational":
        shift = 0.6 * AXIS
    return turn, shift


@pytest.mark.parametrize("case", CASES, ids=str)
def test_a_joint_leaves_exactly_its_freedoms(case):
    kind, pair = case
    model, joint = joined(kind, pair)
    turn, shift = allowed(kind, pair)
    if kind == "universal":
        a, b = (row for row in joint.rows[3:4] for row in (row.a.value, row.b.value))
        turn = Turn.from_rotvec(0.7 * a) * Turn.from_rotvec(-0.4 * b)  # about the child's axis, then the parent's
    motions = [(Turn.identity(), np.zeros(3)), (turn, shift)]
    if "ground" in pair:
        motions = motions[1:] if pair[0] == "ground" else [(turn.inv(), -turn.inv().apply(shift))]
    else:
        common, far = Turn.from_rotvec([0.3, 1.0, -0.7]), np.array([0.5, -2.0, 1.0])
        motions = [(common * t, common.apply(s) + far) for t, s in motions]
    u = moved(model, motions)
    state = state_at(model, u)
    if kind != "distance":
        assert np.abs(model.constraint_values(state)).max() < 1e-12
    J = model.constraint_jacobian(state)
    assert np.linalg.matrix_rank(J.toarray(), tol=1e-9) == RANK[kind] == model.constraints.count
    x, _ = places(model)
    modes = []
    for body in model.bodies:
        full = np.zeros((6, model.slots, 3))
        full[:, body.slots] = rigid_modes((x + u)[body.slots], body.slot_kind)
        modes.append(full.reshape(6, -1))
    modes = np.concatenate(modes)
    assert np.linalg.matrix_rank(J @ modes.T, tol=1e-6) == RANK[kind]


def test_driven_values_are_measured_and_turns_are_counted():
    model, joint = joined("revolute", ("ground", "beam"), ([0, 4], [0, 4 * np.pi]), axis=(0, 1, 0))
    sim = wf.Simulation(model, dt=0.05, integrator="bdf2")
    angles = []
    for _ in range(80):
        sim.step()
        angles.append(sim.joint_value(joint)[0])
    assert angles == pytest.approx(np.pi * sim.joint_record(joint).time, abs=1e-7)


def test_a_driven_joint_never_settles_the_wrong_way_round():
    """The sine of the angle's error vanishes at half a turn too; that is no solution."""
    model, _ = joined("revolute", ("ground", "beam"), ([0, 1], [0, 1.0]), axis=(0, 1, 0))
    values = []
    for angle in (0.2, 1.4, 1.7, 3.0, np.pi):
        u = moved(model, [(Turn.from_rotvec([0, angle, 0]), np.zeros(3))])
        values.append(model.constraint_values(state_at(model, u))[0, -1] / model.size)
    assert values == pytest.approx([np.sin(0.2), np.sin(1.4), 2 - np.sin(1.7), 2 - np.sin(3.0), 2.0])


def test_reaction_of_a_held_body_is_its_weight_and_moment():
    """A cantilever on a fixed joint with the ground: force m g up, moment m g l/2 about the anchor."""
    b = wf.ModelBuilder(gravity=(0, 0, -10.0))
    body = box(b, (0, 0, 0), (1, 0.2, 0.2), (2, 1, 1), wf.SVK(E=1e9, nu=0.3, density=500.0))
    joint = b.add_joint("fixed", parent=wf.GROUND, child=body.surface("x-"))
    model = b.finalize(device="cpu")
    force = wf.solve_static(model, load_steps=1, tol=1e-10).simulation.joint_force(joint)
    weight = 500.0 * 0.04 * 10.0
    assert force[0] == pytest.approx([0, 0, weight, 0, -0.5 * weight, 0], abs=1e-3 * weight)
    assert force[0, :3] == pytest.approx([0, 0, weight], abs=1e-6 * weight)


def test_four_redundant_hinges_hold_a_door():
    """Hinges whose rows repeat each other converge, and share the weight."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    door = box(b, (0, 0, 0), (0.8, 0.04, 2.0), (2, 1, 4), wf.SVK(E=1e9, nu=0.3, density=600.0), name="door")
    hinges = []
    for k, z in enumerate((0.25, 0.75, 1.25, 1.75)):
        near = door.nodes(lambda X, z=z: (X[:, 0] < 0.41) & (np.abs(X[:, 2] - z) < 0.26))
        hinges.append(
            b.add_joint("revolute", parent=wf.GROUND, child=near, anchor=(0, 0.02, z), axis=(0, 0, 1), name=f"h{k}")
        )
    b.set_initial(door, velocity=lambda X: np.cross((0, 0, 1.0), X - np.array([0, 0.02, 0])))
    model = b.finalize(device="cpu")
    sim = wf.Simulation(model, dt=5e-3, integrator="bdf2")
    worst = 0.0
    for _ in range(20):
        report = sim.step()
        worst = max(worst, report.violation[0] / model.size)
        assert report.halvings[0] == 0
    assert worst <= 1e-8
    total = sum(sim.joint_record(h).force[0, -10:, 2].mean() for h in hinges)
    assert total == pytest.approx(600.0 * 0.8 * 0.04 * 2.0 * 9.81, rel=0.05)
    turned = np.mean([sim.joint_value(h)[0] for h in hinges])
    assert turned == pytest.approx(0.1, abs=2e-3)


def pair_of_rods(second):
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = box(b, (0, 0, 0), (1, 0.2, 0.2), (1, 1, 1))
    b.clamp(body.nodes("x-"))
    tip = body.at((1, 0.1, 0.1))
    b.add_constraint("DIST", points=(tip, (2, 0.1, 0.1)), value=([0, 1e-3], [1.0, 1.0]), name="rod A")
    b.add_constraint("DIST", points=(tip, (3, 0.1, 0.1)), value=([0, 1e-2], [2.0, second]), name="rod B")
    return wf.Simulation(b.finalize(device="cpu"), dt=1e-3)


@pytest.mark.parametrize("multipliers", ["newton", "outer"])
def test_conflicting_constraints_are_named(multipliers):
    sim = pair_of_rods(2.2)
    if multipliers == "outer":
        solver = wf.NewtonPCG(multipliers="outer", max_halvings=2, max_outer=10)
        sim = wf.Simulation(sim.model, dt=1e-3, solver=solver)
    before = sim.state.displacement.numpy().copy()
    with pytest.raises(wf.ConstraintError, match=r"'rod A'.*'rod B'|'rod B'.*'rod A'") as caught:
        sim.step(5)
    assert set(caught.value.joints) == {"rod A", "rod B"}
    assert caught.value.violations[0] > 1e-6
    assert (sim.state.displacement.numpy() == before).all()


def test_a_constraint_on_held_nodes_is_named():
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = box(b, (0, 0, 0), (1, 0.2, 0.2))
    b.clamp(body.nodes("x-"))
    b.add_constraint(
        "PIN", points=(body.at((0, 0.1, 0.1)), (0, 0.1, 0.1)), value=([0, 1], [(0, 0, 0), (1, 0, 0)]), name="pull"
    )
    with pytest.raises(wf.ConstraintError, match="'pull'"):
        wf.Simulation(b.finalize(device="cpu"), dt=1e-3).step()


def test_an_open_joint_is_refused_in_dynamics_and_closed_by_statics():
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = box(b, (0, 0, 0), (1, 0.2, 0.2), (2, 1, 1))
    b.clamp(body.nodes("x-"))
    tip = body.at((1, 0.1, 0.1))
    joint = b.add_constraint("PIN", points=(tip, (1, 0.1, 0.1)), value=(0, 0, 0.05), name="lift")
    b.add_probe("tip", tip)
    model = b.finalize(device="cpu")
    with pytest.raises(wf.ConstraintError, match=r"'lift' is 0.05 m off at the start.*solve_static"):
        wf.Simulation(model, dt=1e-3)
    static = wf.solve_static(model, load_steps=1)
    assert static.probe("tip").displacement[0, -1] == pytest.approx([0, 0, 0.05], abs=1e-7)
    assert static.simulation.joint_force(joint)[0, 2] < 0.0  # on the second point, which is in space


def test_a_world_keeps_its_own_multipliers():
    """Two worlds with different gravity give what each gives alone, bit for bit."""

    def run(worlds, gravity):
        b = wf.ModelBuilder(gravity=(0, 0, -1.0))
        first, second = box(b, (0, 0, 0), (1, 0.2, 0.2)), box(b, (1, 0, 0), (2, 0.2, 0.2))
        b.add_joint("revolute", parent=wf.GROUND, child=first.surface("x-"), axis=(0, 1, 0))
        joint = b.add_joint("revolute", parent=first.surface("x+"), child=second.surface("x-"), axis=(0, 1, 0))
        model = b.finalize(device="cpu", worlds=worlds)
        model.set_gravity(gravity)
        sim = wf.Simulation(model, dt=2e-3)
        sim.step(10)
        return sim.state.displacement.numpy(), sim.joint_force(joint)

    both = run(2, [(0, 0, -1.0), (3.0, 0, -9.0)])
    for k, gravity in enumerate([(0, 0, -1.0), (3.0, 0, -9.0)]):
        alone = run(1, gravity)
        assert (alone[0][0] == both[0][k]).all()
        assert (alone[1][0] == both[1][k]).all()


def test_a_reset_world_begins_its_drive_again():
    model, joint = joined("revolute", ("ground", "beam"), ([0, 1], [0, 1.0]), axis=(0, 1, 0), worlds=2)
    sim = wf.Simulation(model, dt=0.01)
    sim.step(5)
    first = sim.joint_record(joint).force[0].copy()
    work = sim.energies()["work_joints"].copy()
    sim.reset([True, False])
    sim.step(5)
    assert (sim.joint_record(joint).force[0, 5:] == first).all()
    assert sim.energies()["work_joints"][0] == work[0]
    assert np.isfinite(sim.energies()["work_joints"]).all()


def test_multipliers_survive_a_checkpoint(tmp_path):
    model, joint = joined("revolute", ("ground", "beam"), ([0, 1], [0, 1.0]), axis=(0, 1, 0))
    sim = wf.Simulation(model, dt=0.01)
    sim.step(5)
    save_checkpoint(sim, tmp_path / "c.npz")
    sim.step(5)
    other = wf.Simulation(model, model.state(), dt=0.01)
    other.resume(tmp_path / "c.npz")
    other.step(5)
    assert (other.state.displacement.numpy() == sim.state.displacement.numpy()).all()
    assert (other.joint_record(joint).force == sim.joint_record(joint).force).all()
    assert other.energies()["work_joints"] == sim.energies()["work_joints"]
    third, _ = joined("revolute", ("ground", "beam"), ([0, 1], [0, 2.0]), axis=(0, 1, 0))
    with pytest.raises(wf.CheckpointError, match="another model"):
        wf.Simulation(third, dt=0.01).resume(tmp_path / "c.npz")


def test_ledger_books_the_work_of_drives():
    """A rod turned up from rest: work of the drive is its kinetic energy and what the integrator loses."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    rod = b.add_beam(
        [(0, 0, 0), (1, 0, 0)], elements=1, section=wf.Rectangle(0.05, 0.04), normal=(0, 0, 1),
        material=wf.SVK(E=1e13, nu=0.3, density=1000.0),
    )  # fmt: skip
    motor = b.add_joint("revolute", parent=wf.GROUND, child=rod.start, axis=(0, 1, 0), drive=wave_up)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3, integrator="bdf2", solver=wf.NewtonPCG(tol=1e-10))
    sim.step(150)
    e = {name: value[0] for name, value in sim.energies().items()}
    mass, rate = 1000.0 * 0.05 * 0.04 * 1.0, np.sin(2 * 0.15)
    assert e["kinetic"] == pytest.approx(0.5 * mass / 3 * rate**2, rel=0.01)
    assert e["work_joints"] == pytest.approx(e["kinetic"] + e["strain"] + e["integrator"], rel=1e-6)
    assert abs(e["ledger_residual"]) < 1e-8 * e["work_joints"]
    record = sim.joint_record(motor)
    angle = 0.5 * (1.0 - np.cos(2.0 * np.append(0.0, record.time)))
    assert record.moment[0, :, 1] @ np.diff(angle) == pytest.approx(e["work_joints"], rel=1e-6)


@wp.func
def wave_up(t: wp.float64) -> wp.float64:
    return wp.float64(0.5) * (wp.float64(1.0) - wp.cos(wp.float64(2.0) * t))


@pytest.mark.parametrize("solver", [
    wf.NewtonPCG(multipliers="outer"), wf.NewtonPCG(preconditioner="block-jacobi"), wf.NewtonPCG(penalty=1e4),
    wf.NewtonPCG(penalty=1.0)], ids=["outer", "block-jacobi", "stiff", "soft"])  # fmt: skip
def test_ways_to_find_the_multipliers_agree(solver):
    def run(solver):
        b = wf.ModelBuilder(gravity=(0, 0, -9.81))
        first, second = box(b, (0, 0, 0), (1, 0.2, 0.2)), box(b, (1, 0, 0), (2, 0.2, 0.2))
        b.add_joint("spherical", parent=wf.GROUND, child=first.surface("x-"))
        b.add_joint("revolute", parent=first.surface("x+"), child=second.surface("x-"), axis=(0, 1, 0))
        b.add_probe("tip", second.surface("x+"))
        sim = wf.Simulation(b.finalize(device="cpu"), dt=5e-3, solver=solver, constraint_tol=1e-11)
        sim.step(20)
        return sim.probe("tip").displacement[0, -1]

    assert run(solver) == pytest.approx(run(wf.NewtonPCG()), abs=1e-7)


@pytest.mark.parametrize("tol", [1e-5, 1e-3, 1e-2])
def test_a_loose_tolerance_of_forces_does_not_open_joints(tol):
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    end = wf.GROUND
    for k in range(10):
        link = b.add_beam(
            [(0.2 * k, 0, 0), (0.2 * (k + 1), 0, 0)], elements=1, section=wf.Rectangle(0.02, 0.02), normal=(0, 0, 1),
            material=wf.SVK(E=1e9, nu=0.3, density=1e6 if k == 9 else 1000.0),
        )  # fmt: skip
        b.add_joint("revolute", parent=end, child=link.start, axis=(0, 1, 0))
        end = link.end
    sim = wf.Simulation(b.finalize(device="cpu"), dt=0.02, integrator="bdf2", solver=wf.NewtonPCG(tol=tol))
    halvings = sum(sim.step().halvings[0] for _ in range(20))
    assert halvings == 0
    assert sim.max_violation <= 1e-8 * sim.model.size
    assert sim.totals["newton"][0] < 20 * 8


def test_float32_holds_its_tolerance():
    model, joint = joined("revolute", ("ground", "surface"), dtype="float32", axis=(0, 1, 0))
    sim = wf.Simulation(model, dt=1e-3)
    sim.step(5)
    assert sim.violation(joint)[0] <= 1e-5 * model.size


def two_chains(moduli):
    """Chains of two links that do not touch; the later ones stand 5 m aside."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    tips = []
    for k, E in enumerate(moduli):
        end = wf.GROUND
        for link in range(2):
            x = [(0.5 * link, 5.0 * k, 0), (0.5 * (link + 1), 5.0 * k, 0)]
            beam = b.add_beam(
                x, elements=1, section=wf.Rectangle(0.05, 0.05), normal=(0, 0, 1),
                material=wf.SVK(E=E, nu=0.3, density=2700.0),
            )  # fmt: skip
            b.add_joint("revolute", parent=end, child=beam.start, anchor=x[0], axis=(0, 1, 0))
            end = beam.end
        tips.append(beam)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3, integrator="bdf2")
    halvings = sum(sim.step().halvings[0] for _ in range(30))
    return [sim.positions(tip)[0] - [0, 5.0 * k, 0] for k, tip in enumerate(tips)], sim.totals["newton"][0], halvings


def test_a_converged_mechanism_is_left_alone_by_another():
    both, newton, halvings = two_chains([1e11, 1e5])
    for k, E in enumerate((1e11, 1e5)):
        alone, own, _ = two_chains([E])
        assert np.abs(both[k] - alone[0]).max() < 1e-9
        assert newton <= own + 30
    assert halvings == 0


@pytest.mark.parametrize("sag", [0.0, 1e-4, 1e-2, 5e-2])
def test_a_slightly_curved_face_is_held_as_a_flat_one(sag):
    """A column on a fixed joint at its foot, bent by a load at its head: as stiff however little the foot is curved."""
    mesh = wf.mesh.box((0.1, 0.1, 0.6), cells=(2, 2, 6))
    X = mesh.points.copy()
    bow = 1.0 - ((X[:, 0] - 0.05) ** 2 + (X[:, 1] - 0.05) ** 2) / 0.05**2
    X[:, 2] -= sag * 0.1 * bow * (1.0 - X[:, 2] / 0.6)
    column = wf.mesh.Mesh(X, mesh.cells, "tetra10", name="column")
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_solid(column, material=wf.SVK(E=1e8, nu=0.3))
    b.add_joint("fixed", parent=wf.GROUND, child=body.surface(lambda c: c[:, 2] < 1e-3))
    b.add_point_load(body.nodes(lambda X: X[:, 2] > 0.6 - 1e-9), (20.0, 0, 0))
    b.add_probe("tip", body.nodes(lambda X: X[:, 2] > 0.6 - 1e-9))
    tip = wf.solve_static(b.finalize(device="cpu"), load_steps=1).probe("tip").displacement[0, -1, 0]
    # the face's mean is held, not its points: a curved one gives a little
    assert tip == pytest.approx(20.0 * 0.6**3 / (3 * 1e8 * 0.1**4 / 12), rel=0.06 if sag < 0.05 else 0.12)


def spun(rate, dt, **options):
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    rod = b.add_beam(
        [(0, 0, 0), (0.1, 0, 0)], elements=1, section=wf.Rectangle(0.02, 0.02), normal=(0, 0, 1),
        material=wf.SVK(E=1e9, nu=0.3, density=1000.0),
    )  # fmt: skip
    motor = b.add_joint(
        "revolute", parent=wf.GROUND, child=rod.start, axis=(0, 1, 0), drive=([0, 10], [0, 10 * rate]), name="motor"
    )
    b.set_initial(rod, velocity=lambda X: np.cross((0, rate, 0), X))
    return wf.Simulation(b.finalize(device="cpu"), dt=dt, **options), motor, rod


def test_a_drive_of_more_than_half_a_turn_per_step_is_not_taken_for_less():
    sim, motor, rod = spun(2 * np.pi, 1.0)
    report = sim.step()
    assert report.halvings[0] >= 2
    assert sim.joint_value(motor)[0] == pytest.approx(2 * np.pi, abs=1e-7)
    assert sim.energies()["kinetic"][0] > 1e-3
    sim, motor, rod = spun(2 * np.pi, 1.0, solver=wf.NewtonPCG(max_halvings=0))
    with pytest.raises(wf.Error, match=r"'motor'|not accepted"):
        sim.step()


def test_results_of_statics_know_their_own_time():
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    rod = b.add_beam(
        [(0, 0, 0), (1, 0, 0)], elements=2, section=wf.Rectangle(0.05, 0.05), normal=(0, 0, 1), material=LAW
    )
    motor = b.add_joint("revolute", parent=wf.GROUND, child=rod.start, axis=(0, 1, 0), drive=([0, 1], [0, 7.0]))
    static = wf.solve_static(b.finalize(device="cpu"), load_steps=4)
    assert static.violation(motor)[0] < 1e-8
    assert static.simulation.joint_value(motor)[0] == pytest.approx(7.0, abs=1e-8)
    assert static.joint_force(motor).shape == (1, 6)


SINGLE = {
    "DP1": lambda p, q: (p.at((0, 0, 0)), p.at((1, 0.2, 0.2)), q.at((1, 0, 0)), q.surface("x+")),
    "DP1 with places": lambda p, q: (p.at((0, 0, 0)), p.surface("x+"), (0, 0, 0), (0, 1, 2)),
    "DP2": lambda p, q: (p.at((0, 0, 0)), p.at((1, 0.2, 0.2)), p.at((0.5, 0.1, 0)), q.at((2, 0, 0))),
    "DIST": lambda p, q: (p.at((0.2, 0.1, 0.1)), q.surface("x+")),
    "DIST of one body": lambda p, q: (p.at((0.2, 0.1, 0.1)), p.surface("x+")),
    "PIN": lambda p, q: (p.at((0.2, 0.1, 0.1)), q.surface("x+")),
}


@wp.func
def path(t: wp.float64) -> wp.vec3d:
    return wp.vec3d(wp.float64(-1.8), wp.sin(t), wp.float64(0.1))


@pytest.mark.parametrize("case", SINGLE)
@pytest.mark.parametrize("sort", ["constant", "samples", "function"])
def test_single_constraints_match_their_definition_and_differences(case, sort):
    kind = case.split()[0]
    b, p, q = bodies()
    points = SINGLE[case](p, q)
    if kind == "PIN":
        value = {"constant": (1.0, 2.0, 3.0), "samples": ([0, 1], [(1, 2, 3), (2, 3, 4)]), "function": path}[sort]
    else:
        value = {"constant": 0.7, "samples": ([0, 1], [0.7, 1.7]), "function": wave}[sort]
    joint = b.add_constraint(kind, points=points, value=value)
    model = b.finalize(device="cpu")
    rng = np.random.default_rng(5)
    u = random_pose(model, rng)
    x, position = places(model)

    def place(point):
        if isinstance(point, tuple):
            return np.array(point, dtype=float)
        if isinstance(point, wf.MaterialPoint):
            return point.weights @ (x + u)[point.body.slots[point.slots]]
        slots, weights = assembly.surface_weights(point)
        return weights @ (x + u)[point.body.slots[slots]] / weights.sum()

    P = [place(point) for point in points]
    f = np.array([1.0, 2.0, 3.0]) if kind == "PIN" else 0.7
    if sort == "function" and kind == "PIN":
        f = np.array([-1.8, 0.0, 0.1])
    if kind == "PIN":
        expected = P[0] - P[1] - f
    elif kind == "DIST":
        expected = [np.linalg.norm(P[1] - P[0]) - f]
    else:
        scale = model.size / np.prod([np.linalg.norm(v.value) for v in (joint.rows[0].a, joint.rows[0].b)])
        expected = [scale * ((P[1] - P[0]) @ (P[3] - P[2]) - f)]
    state = state_at(model, u)
    assert model.constraint_values(state)[0] == pytest.approx(np.array(expected), abs=1e-12)
    d = rng.normal(size=u.shape)
    h = 1e-5
    ahead, behind = (state_at(model, u + k * h * d) for k in (1, -1))
    J = model.constraint_jacobian(state)
    slope = (model.constraint_values(ahead) - model.constraint_values(behind))[0] / (2 * h)
    assert J @ d.ravel() == pytest.approx(slope, abs=1e-8 * np.abs(slope).max())
    lam = rng.normal(size=model.constraints.count)
    bend = (model.constraint_jacobian(ahead) - model.constraint_jacobian(behind)).T @ lam / (2 * h)
    product = model.constraint_curvature(state, lam, d)[0].ravel()
    assert product == pytest.approx(bend, abs=1e-8 * max(np.abs(bend).max(), 1e-3))


def test_reaction_of_dp2_is_that_on_its_last_point():
    """A block kept at its height by a DP2: the force is its weight."""
    b = wf.ModelBuilder(gravity=(0, 0, -10.0))
    stiff = wf.SVK(E=1e12, nu=0.3, density=1000.0)
    held, block = box(b, (0, 0, 0), (1, 0.2, 0.2), law=stiff), box(b, (1, 0, 0), (2, 0.2, 0.2))
    b.clamp(held.nodes(lambda X: X[:, 2] < 1e-9))
    points = (held.at((0, 0, 0)), held.at((0, 0, 0.2)), held.at((0, 0, 0.2)), block.surface("z+"))
    joint = b.add_constraint("DP2", points=points, value=0.0)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=0.05)
    sim.step(60)
    assert sim.joint_record(joint).force[0, -20:].mean(axis=0) == pytest.approx([0, 0, 400.0], abs=8.0)


def test_failed_worlds_with_constraints_are_frozen():
    model = pair_of_rods(2.2).model
    sim = wf.Simulation(model, dt=1e-3, on_failure="freeze", solver=wf.NewtonPCG(max_halvings=1))
    for _ in range(4):
        sim.step()
    assert list(sim.status) == [1]
    joint = model.constraints.joints[0]
    assert np.isnan(sim.joint_force(joint)).all()
    assert np.isnan(sim.joint_record(joint).force[0, -1]).all()


def test_records_can_be_left_out():
    model, joint = joined("revolute", ("ground", "beam"), ([0, 1], [0, 1.0]), axis=(0, 1, 0))
    sim = wf.Simulation(model, dt=0.01, record=False)
    sim.step(5)
    assert sim.joint_record(joint).time == pytest.approx([0.05])


def test_a_reset_to_an_open_state_is_refused():
    model, _ = joined("spherical", ("ground", "surface"))
    sim = wf.Simulation(model, dt=0.01)
    moved_state = state_at(model, 0.3 + np.zeros((model.slots, 3)) * (model.slot_kind == 0)[:, None])
    with pytest.raises(wf.ConstraintError, match="snap shut"):
        sim.reset(state=moved_state)


def test_joints_at_the_origin_do_not_mind_rounding():
    b = wf.ModelBuilder()
    block = b.add_solid(wf.mesh.box((0.3, 0.3, 0.3), cells=(1, 1, 1), origin=(-0.3, -0.15, -0.15)), material=LAW)
    beam = b.add_beam(
        [(0, 0, 0), (1, 0, 0)], elements=2, section=wf.Rectangle(0.05, 0.05), normal=(0, 0, 1), material=LAW
    )
    b.add_joint("revolute", parent=block.surface("x+"), child=beam.start, axis=(0, 1, 0))
    b.add_constraint("PIN", points=(block.surface("x+"), beam.start))
    near = beam.at((3e-17, 0, 0))
    with pytest.raises(wf.ModelError, match="coincide"):
        b.add_constraint("DIST", points=(block.surface("x+"), near))
    assert b.finalize(device="cpu").constraints.count == 8


@pytest.mark.parametrize("swap", [False, True])
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0)])
def test_a_hinge_asks_only_for_directions_that_are_known(swap, axis):
    """Nodes in a plane do not tell how its normal turns; a hinge finds another way round."""
    b = wf.ModelBuilder()
    body = box(b, (0, 0, 0), (1, 0.2, 0.2))
    sides = (wf.GROUND, body.nodes("x-"))
    parent, child = sides[::-1] if swap else sides
    b.add_joint("revolute", parent=parent, child=child, axis=axis, anchor=(0, 0.1, 0.1))
    assert b.finalize(device="cpu").constraints.count == 5


# welds


def test_beam_welded_to_a_solid_bends_as_one_beam():
    """A cantilever, half T10 solid and half 3243 beam, under a tip load: deflection of the whole as of one beam."""
    law = wf.SVK(E=1e9, nu=0.0, density=1.0)

    def tip(mixed):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        beam = b.add_beam(
            [(0.5 if mixed else 0.0, 0, 0), (1, 0, 0)], elements=4 if mixed else 8, section=wf.Rectangle(0.1, 0.1),
            normal=(0, 0, 1), material=law,
        )  # fmt: skip
        if mixed:
            solid = box(b, (0, -0.05, -0.05), (0.5, 0.05, 0.05), (8, 2, 2), law)
            b.clamp(solid.nodes("x-"))
            weld = b.weld(beam.start, solid.surface("x+"))
            assert len(weld.rows) == 9
        else:
            b.clamp(beam.start)
        b.add_point_load(beam.end, (0, 0, -10.0))
        b.add_probe("tip", beam.end)
        static = wf.solve_static(b.finalize(device="cpu"), load_steps=1)
        if mixed:
            force = static.simulation.joint_force(weld)[0]
            assert force == pytest.approx([0, 0, 10.0, 0, -5.0, 0], abs=0.02)
        return static.probe("tip").displacement[0, -1, 2]

    assert tip(True) == pytest.approx(tip(False), rel=0.01)


def test_a_weld_passes_tension_exactly():
    """Shell and beam welded to a solid of the same section under tension: uniform strain all through (nu = 0)."""
    law = wf.SVK(E=1e6, nu=0.0, density=1.0)
    for kind in ("shell", "beam"):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        solid = box(b, (0, 0, -0.05), (0.5, 0.4, 0.05), (2, 2, 1), law)
        b.clamp(solid.nodes("x-"))
        if kind == "shell":
            grid = wf.mesh.grid((0.5, 0.4), cells=(2, 2))
            other = b.add_shell(grid, thickness=0.1, material=law, transform=(np.eye(3), (0.5, 0, 0)))
            b.weld(other.edge("x-"), solid)
        else:
            other = b.add_beam(
                [(0.5, 0.2, 0), (1, 0.2, 0)], elements=2, section=wf.Rectangle(0.4, 0.1), normal=(0, 0, 1), material=law
            )
            b.weld(other.start, solid)
        end = other.surface("x+" if kind == "shell" else "end")
        b.add_traction(end, (100.0, 0, 0))
        b.add_probe("end", end)
        b.add_probe("middle", solid.surface("x+"))
        static = wf.solve_static(b.finalize(device="cpu"), load_steps=1, tol=1e-11)
        middle, far = (static.probe(name).displacement[0, -1] for name in ("middle", "end"))
        assert far == pytest.approx(2.0 * middle, abs=1e-3 * far[0])
        stretch = 1.0 + middle[0] / 0.5
        assert 0.5 * stretch * (stretch**2 - 1.0) * 1e6 == pytest.approx(100.0, rel=1e-3)


def test_a_weld_to_a_solid_is_stiff_in_turning():
    """A shell edge in a solid turns with it: the weld carries moment through its director."""
    law = wf.SVK(E=1e8, nu=0.0, density=1.0)
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    solid = box(b, (0, 0, -0.05), (0.2, 0.4, 0.05), (2, 2, 1), law)
    b.clamp(solid.nodes(lambda X: X[:, 0] > -1))
    plate = b.add_shell(
        wf.mesh.grid((0.5, 0.4), cells=(4, 2)), thickness=0.02, material=law, transform=(np.eye(3), (0.2, 0, 0))
    )
    b.weld(plate.edge("x-"), solid)
    b.add_traction(plate.surface("x+"), (0, 0, 100.0))
    b.add_probe("tip", plate.surface("x+"))
    model = b.finalize(device="cpu")
    tip = wf.solve_static(model, load_steps=1).probe("tip").displacement[0, -1, 2]
    EI = 1e8 * 0.4 * 0.02**3 / 12
    assert tip == pytest.approx(100.0 * 0.4 * 0.02 * 0.5**3 / (3 * EI), rel=0.02)


def test_welded_bodies_fall_as_one():
    b = wf.ModelBuilder(gravity=(0, 0, -10.0))
    solid = box(b, (0, -0.1, -0.1), (0.5, 0.1, 0.1))
    beam = b.add_beam(
        [(0.5, 0, 0), (1, 0, 0)], elements=2, section=wf.Rectangle(0.1, 0.1), normal=(0, 0, 1), material=LAW
    )
    b.weld(beam.start, solid)
    model = b.finalize(device="cpu")
    sim = wf.Simulation(model, dt=0.01)
    sim.step(20)
    n = 20
    for body in (solid, beam):
        assert sim.displacements(body)[0] == pytest.approx(
            np.tile([0, 0, -10.0 * 1e-4 * n * (n + 1) / 2], (len(body.mesh.points), 1)), abs=1e-11
        )


# what is refused


def bodies():
    b = wf.ModelBuilder()
    return b, box(b, (0, 0, 0), (1, 0.2, 0.2), name="one"), box(b, (1, 0, 0), (2, 0.2, 0.2), name="two")


def ends(one, two):
    return {"parent": one.surface("x+"), "child": two.surface("x-")}


BAD = {
    "kind": (lambda b, p, q: b.add_joint("hinge", **ends(p, q)), r"kind 'hinge' is unknown; there are spherical"),
    "no axis": (lambda b, p, q: b.add_joint("revolute", **ends(p, q)), r"a revolute joint needs an axis"),
    "axis": (lambda b, p, q: b.add_joint("fixed", axis=(1, 0, 0), **ends(p, q)), r"a fixed joint has no axis"),
    "axis zero": (lambda b, p, q: b.add_joint("revolute", axis=(0, 0, 0), **ends(p, q)), r"axis is zero"),
    "drive": (lambda b, p, q: b.add_joint("spherical", drive=1.0, **ends(p, q)), r"a spherical joint can't be driven"),
    "apart": (
        lambda b, p, q: b.add_joint("spherical", parent=p.surface("x-"), child=q.surface("x-")),
        r"are 1 m apart; say where: anchor=",
    ),
    "one ground": (
        lambda b, p, q: b.add_joint("fixed", parent=wf.GROUND, child=wf.GROUND),
        r"neither parent nor child is a body",
    ),
    "a node can't turn": (
        lambda b, p, q: b.add_joint("fixed", parent=wf.GROUND, child=p.nodes([0])),
        r"does not tell how the direction",
    ),
    "handle": (lambda b, p, q: b.add_joint("fixed", parent=p, child=q.surface("x-")), r"expected .* got the body"),
    "name": (
        lambda b, p, q: [b.add_joint("fixed", name="j", **ends(p, q)) for _ in "ab"],
        r"joint name 'j' is used twice",
    ),
    "other builder": (
        lambda b, p, q: b.add_joint("fixed", parent=wf.GROUND, child=bodies()[1].surface("x-")),
        r"another builder",
    ),
    "axis2": (
        lambda b, p, q: b.add_joint("universal", axis=(1, 0, 0), axis2=(1, 1, 0), **ends(p, q)),
        r"axis2 = .* perpend",
    ),
    "ground rod": (
        lambda b, p, q: b.add_joint("distance", parent=wf.GROUND, child=p.at((0, 0, 0))),
        r"say where on the ground",
    ),
    "rod of no length": (
        lambda b, p, q: b.add_joint("distance", parent=p.at((1, 0.1, 0.1)), child=q.at((1, 0.1, 0.1))),
        r"its two points coincide",
    ),
    "DIST of no length": (
        lambda b, p, q: b.add_constraint("DIST", points=(p.at((1, 0, 0)), q.at((1, 0, 0)))),
        r"its two points coincide",
    ),
    "DIST negative": (
        lambda b, p, q: b.add_constraint("DIST", points=(p.at((0, 0, 0)), q.at((1, 0, 0))), value=-1.0),
        r"the distance must be positive, the law falls to -1 m",
    ),
    "DP1 of no length": (
        lambda b, p, q: b.add_constraint("DP1", points=(p.at((0, 0, 0)), p.at((0, 0, 0)), q.at((1, 0, 0)), (0, 0, 9))),
        r"its points P and Q coincide",
    ),
    "DP2 body": (
        lambda b, p, q: b.add_constraint(
            "DP2", points=(p.at((0, 0, 0)), p.at((1, 0, 0)), q.at((1, 0, 0)), q.at((2, 0, 0)))
        ),
        r"use DP1",
    ),
    "points": (lambda b, p, q: b.add_constraint("PIN", points=(p.at((0, 0, 0)),)), r"points must be 2 points"),
    "constraint": (lambda b, p, q: b.add_constraint("DP3", points=()), r"there are DP1, DP2, DIST, PIN"),
    "pin apart": (
        lambda b, p, q: b.add_constraint("PIN", points=(p.at((0, 0, 0)), q.at((1, 0, 0)))),
        r"are 1 m apart in the reference; value=",
    ),
    "all in space": (lambda b, p, q: b.add_constraint("PIN", points=((0, 0, 0), (0, 0, 0))), r"none of its points"),
    "weld outside": (lambda b, p, q: b.weld(p.surface("x-"), q), r"lies outside .*must lie in the other body"),
    "weld to the wrong surface": (
        lambda b, p, q: b.weld(p.surface("x+"), q.surface("x+")),
        r"is not on surface 'x\+' of body 'two'",
    ),
    "same place": (
        lambda b, p, q: b.add_joint("fixed", parent=p.surface("x+"), child=p.surface("x+")),
        r"are the same place",
    ),
    "axis2 of a rod": (
        lambda b, p, q: b.add_joint("distance", parent=p.at((0, 0, 0)), child=q.at((1, 0, 0)), axis2=(1, 0, 0)),
        r"only universal joints have an axis2",
    ),
    "no name": (lambda b, p, q: b.add_joint("fixed", name="", **ends(p, q)), r"joint name '' is no text"),
    "name of a list": (lambda b, p, q: b.add_joint("fixed", name=["a"], **ends(p, q)), r"is no text"),
    "weld itself": (lambda b, p, q: b.weld(p.surface("x-"), p), r"both sides are body 'one'"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_joints_are_refused(case):
    action, text = BAD[case]
    with pytest.raises(wf.ModelError, match=text):
        action(*bodies())


def test_handles_of_another_model_are_refused():
    model, _ = joined("fixed", ("ground", "surface"))
    _, other = joined("fixed", ("ground", "surface"))
    sim = wf.Simulation(model, dt=1e-3)
    for ask in (sim.joint_force, sim.violation, sim.joint_record, sim.joint_value):
        for what in (other, "elbow"):
            with pytest.raises(wf.ModelError, match="expected a joint of this model"):
                ask(what)
        if ask != sim.joint_value:
            ask("fixed_1")


@wp.func
def mixed_precision(t: wp.float64) -> wp.float64:
    return 0.5 * t


def test_a_law_that_does_not_compile_is_named():
    model, _ = joined("revolute", ("ground", "beam"), mixed_precision, axis=(0, 1, 0))
    with pytest.raises(wf.ModelError, match=r"mixed_precision.*write it in the precision"):
        wf.Simulation(model, dt=1e-3)


def test_a_mechanism_without_support_has_no_statics():
    model, _ = joined("revolute", ("ground", "surface"))
    with pytest.raises(wf.ModelError, match="leave 1 rigid motion free"):
        wf.solve_static(model)
    model, _ = joined("fixed", ("ground", "surface"))
    assert wf.solve_static(model, load_steps=1).report.converged.all()


def test_rows_are_sparse():
    """No dense Jacobian: entries per row do not grow with the model."""
    b = wf.ModelBuilder()
    end = wf.GROUND
    for k in range(20):
        whole = box(b, (k, 0, 0), (k + 1, 0.2, 0.2)).nodes(lambda X: X[:, 0] > -1)
        b.add_joint("revolute", parent=end, child=whole, anchor=(k, 0.1, 0.1), axis=(0, 1, 0))
        end = whole
    model = b.finalize(device="cpu")
    J = model.constraint_jacobian(model.state())
    assert isinstance(J, sp.csr_matrix)
    assert np.diff(J.indptr).max() <= 3 * 2 * 27
    constraints = model.constraints
    assert constraints.cluster_sizes.max() == 5  # too many coupled rows for one inverse: joints are swept by colour
    assert len(constraints.colour_sizes) == 2
    sim = wf.Simulation(model, dt=1e-3)
    sim.step(3)
    assert sim.max_violation <= 1e-8 * model.size
