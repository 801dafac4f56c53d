"""Constraints and joints: derivatives against differences, freedoms, reactions, conflicts, redundancy."""

import numpy as np
import pytest
import warp as wp
from constraint_models import AXIS, LAW, box, joined, moved, places, random_pose, state_at, wave
from scipy.spatial.transform import Rotation as Turn

import warpfea as wf
from warpfea.model.assembly import rigid_modes
from warpfea.simulation.checkpoint import save_checkpoint

RANK = {"spherical": 3, "universal": 4, "revolute": 5, "cylindrical": 4, "translational": 5, "fixed": 6, "distance": 1}
PAIRS = [("ground", "surface"), ("surface", "nodes"), ("beam", "beam"), ("shell", "point"), ("ground", "beam")]
PAIRS += [("beam", "ground"), ("beam", "shell point"), ("ground", "shell")]
CASES = [(kind, pair) for kind in RANK for pair in PAIRS]
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
        entries = [vector.entries() for vector in row.vectors]
        a, b, a2 = (vector.value + e[1] @ u[e[0]] for vector, e in zip(row.vectors, entries))
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
    J = model.evaluation.constraint_jacobian(state_at(model, u))
    assert np.abs(J.toarray() - by_hand(model, u)).max() < 1e-13
    h = 1e-5
    ahead, behind = (state_at(model, u + k * h * p) for k in (1, -1))
    slope = (model.evaluation.constraint_values(ahead) - model.evaluation.constraint_values(behind))[0] / (2 * h)
    scale = np.abs(J @ p.ravel()).max()
    assert J @ p.ravel() == pytest.approx(slope, abs=1e-8 * scale)
    change = model.evaluation.constraint_jacobian(ahead) - model.evaluation.constraint_jacobian(behind)
    force = change.T @ lam / (2 * h)
    curvature = model.evaluation.constraint_curvature(state_at(model, u), lam, p)[0].ravel()
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
        assert np.abs(model.evaluation.constraint_values(state)).max() < 1e-12
    J = model.evaluation.constraint_jacobian(state)
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
        values.append(model.evaluation.constraint_values(state_at(model, u))[0, -1] / model.size)
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
    with pytest.raises(wf.ConstraintError, match=r"'lift': initial violation 0.05 m.*solve_static"):
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
    moved_state = state_at(model, 0.3 + np.zeros((model.slots, 3)) * (model.slot_table.kind == 0)[:, None])
    with pytest.raises(wf.ConstraintError, match="initial violation"):
        sim.reset(state=moved_state)


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
