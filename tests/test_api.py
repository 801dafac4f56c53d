"""Every delivered line of the public interface, as users write it."""

import numpy as np
import pytest
import warp as wp

import warpfea as wf


@wp.func
def my_field(x: wp.vec3d, t: wp.float64) -> wp.vec3d:
    return wp.vec3d(wp.float64(0.0), wp.float64(0.0), -x[2])


@pytest.fixture
def hook_file(tmp_path):
    """A mesh file with two element groups, a fixed and a pulled side."""
    import meshio

    mesh = wf.mesh.box((0.2, 0.1, 0.1), cells=(2, 1, 1))
    arm = (mesh.centroids()[:, 0] < 0.1).astype(np.int32)
    faces = {name: mesh.faces(mesh.surface_sets[side]) for name, side in (("fixed", "x-"), ("pull", "x+"))}
    cells = [("tetra10", mesh.cells[arm == 1]), ("tetra10", mesh.cells[arm == 0])]
    cells += [("triangle6", f) for f in faces.values()]
    tags = [np.full(len(c), k + 1) for k, (_, c) in enumerate(cells)]
    names = {"arm": [1, 3], "pad": [2, 3], "fixed": [3, 2], "pull": [4, 2]}
    out = meshio.Mesh(
        1e3 * mesh.points,
        cells,
        cell_data={"gmsh:physical": tags, "gmsh:geometrical": tags},
        field_data={k: np.array(v) for k, v in names.items()},
    )
    path = tmp_path / "hook.msh"
    meshio.write(path, out, file_format="gmsh22", binary=False)
    return path


def test_the_interface(hook_file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    steel = wf.SVK(E=7e8, nu=0.33, density=2700.0)
    rubber = wf.MooneyRivlin(
        mu10=3e5, mu01=1e5, k=1e8, density=1000.0, damping=wf.KelvinVoigt(eta=3e3, lambda_v=4.5e3, form="incremental")
    )
    soft = wf.NeoHookean(mu=4e5, k=1e7, density=1000.0)
    for law in (wf.SVK, wf.MooneyRivlin, wf.NeoHookean):
        lam, mu = law.from_E_nu(E=1e6, nu=0.3, density=10.0).lame
        assert (lam, mu) == pytest.approx((1e6 * 0.3 / (1.3 * 0.4), 1e6 / 2.6))

    b = wf.ModelBuilder(gravity=(0, 0, -9.81), up_axis="Z")
    hook = b.add_solid(
        "hook.msh",
        material={"arm": steel, "pad": rubber},
        quadrature="tet4",
        scale=1e-3,
        transform=None,
        initial=None,
        name="hook",
    )
    box = b.add_solid(wf.mesh.box((1, 0.1, 0.1), cells=(10, 2, 2), element="T10"), material=soft, name="box")
    assert len(hook.nodes("fixed"))
    assert len(hook.surface("pull"))
    assert len(hook.elements("arm"))
    assert len(hook.nodes(lambda X: X[:, 0] < 1e-9))
    assert hook.at((0.1, 0, 0)).weights.sum() == pytest.approx(1.0)
    assert len(box.surface("x+"))

    b.clamp(hook.nodes("fixed"))
    b.drive(box.nodes("x+"), displacement=([0, 1], [(0, 0, 0), (0.1, 0, 0)]))
    b.drive(
        box.nodes("x-"), rotation=wf.Rotation(anchor=(0, 0.05, 0.05), axis=(1, 0, 0), angle=([0, 1], [0, np.pi / 2]))
    )
    b.add_point_load(box.at((0.5, 0.1, 0.05)), force=(0, 0, -100))
    b.add_traction(hook.surface("pull"), (0, 0, -1e3))
    b.add_pressure(box.surface("z+"), 2e4)
    b.add_body_force(my_field, bodies=[box])
    b.set_initial(hook, velocity=(0, 0, 0), angular_velocity=(0, 0, 0))
    b.add_probe("tip", hook.surface("pull"))
    b.add_probe("p", box.at((0.5, 0.05, 0.05)))

    model = b.finalize(device="cpu", dtype="float64", worlds=1)
    info = model.info()
    assert {"features", "left_out", "bytes", "kernels"} <= set(info)
    state = model.state()
    assert state.displacement.shape == (1, model.slots)
    assert state.velocity.shape == (1, model.slots)
    assert state.time.shape == (1,)
    sim = wf.Simulation(
        model,
        state,
        dt=1e-3,
        integrator="backward_euler",
        solver=wf.NewtonPCG(tol=1e-8, max_newton=30, max_pcg=2000, preconditioner="auto"),
        constraint_tol=1e-8,
    )
    rep = sim.step()
    for name in ("converged", "newton", "pcg", "residual", "halvings", "status"):
        assert getattr(rep, name).shape == (1,)
    sim.run(
        t_end=0.01,
        outputs=[
            wf.USDWriter("o.usdc", fps=60, fields=["von_mises"]),
            wf.VTUWriter("vtu"),
            wf.Checkpoint("c.npz", every=100),
        ],
        on_step=None,
        progress=None,
    )
    sim.resume("c.npz")
    assert sim.time == pytest.approx(0.01)

    N = len(hook.mesh.points)
    assert sim.positions(hook).shape == sim.displacements(hook).shape == sim.velocities(hook).shape == (1, N, 3)
    p = sim.probe("tip")
    assert p.time.shape == (10,)
    assert p.position.shape == p.displacement.shape == p.velocity.shape == (1, 10, 3)
    names = ["kinetic", "strain", "potential", "work", "viscous", "contact", "friction", "integrator"]
    names.append("ledger_residual")
    assert all(sim.energies()[name].shape == (1,) for name in names)
    assert sim.field("von_mises", hook).shape == (1, N)
    assert sim.reaction(hook.nodes("fixed")).shape == (1, 3)
    assert model.internal_force(state).shape == model.viscous_force(state).shape == (1, model.slots, 3)
    assert model.strain_energy(state).shape == (1,)
    n = 3 * model.slots
    assert model.mass_matrix().shape == model.tangent_matrix(state, world=0).shape == (n, n)
    assert model.free_slots.shape == (model.slots, 3)
    assert hook.slots.shape == (N,)


def test_statics_and_worlds():
    b = wf.ModelBuilder()
    box = b.add_solid(
        wf.mesh.box((1, 0.2, 0.2), cells=(4, 1, 1)), material=wf.SVK(E=1e6, nu=0.3, density=1000.0), name="box"
    )
    b.clamp(box.nodes("x-"))
    b.add_probe("tip", box.surface("x+"))
    static = wf.solve_static(b.finalize(device="cpu"), load_steps=10, tol=1e-10)
    assert static.report.converged.all()
    assert static.state.displacement.shape[0] == 1
    assert static.probe("tip").displacement[0, -1, 2] < 0.0
    m = b.finalize(device="cpu", worlds=4)
    m.set_gravity(np.outer([1, 2, 3, 4], (0, 0, -1.0)))
    s = wf.Simulation(m, dt=1e-3)
    s.step(3)
    assert list(s.status) == [0, 0, 0, 0]
    tip = s.probe("tip").displacement[:, -1, 2]
    assert tip == pytest.approx(tip[0] * np.arange(1, 5), rel=1e-6)
    s.reset([True, False, False, True], state=None)
    assert list(s.time > 0) == [False, True, True, False]


def test_a_model_has_few_public_names():
    """The rest belongs to its parts: slot_table, components, memory, masses, parameters, terms, evaluation."""
    b = wf.ModelBuilder()
    b.add_solid(wf.mesh.box((1, 0.1, 0.1), cells=(2, 1, 1)), material=wf.NeoHookean(mu=4e5, k=1e7, density=1000.0))
    names = [name for name in dir(b.finalize(device="cpu")) if not name.startswith("_")]
    assert len(names) <= 40, names


def test_a_simulation_has_parts_and_no_bases():
    assert wf.Simulation.__mro__ == (wf.Simulation, object)
    b = wf.ModelBuilder()
    body = b.add_solid(wf.mesh.box((1, 0.1, 0.1), cells=(2, 1, 1)), material=wf.SVK(E=1e6, nu=0.3, density=1000.0))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    sim.step()
    assert sim.statistics.steps == sim.steps == 1
    sim.steps += 1  # of the part, not of the simulation beside it
    assert sim.statistics.steps == 2
    assert sim.positions == sim.results.positions
    assert sim.probe == sim.records.probe
    assert wf.Simulation.positions.__doc__ == sim.positions.__doc__
    assert np.array_equal(sim.positions(body), sim.results.positions(body))


def test_later_additions_leave_a_model_as_it_is():
    b = wf.ModelBuilder()
    body = b.add_solid(wf.mesh.box((1, 0.1, 0.1), cells=(2, 1, 1)), material=wf.SVK(E=1e6, nu=0.3, density=1000.0))
    model = b.finalize(device="cpu")
    b.clamp(body.nodes("x-"))
    b.add_probe("tip", body.surface("x+"))
    assert model.description.probes == []
    assert model.resized(2).free_slots.all()
    assert not b.finalize(device="cpu").free_slots.all()


def test_contact():
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    soft = wf.NeoHookean(mu=4e5, k=1e7, density=1000.0)
    box = b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1)), material=soft, name="box")
    floor = b.add_collider(wf.HalfSpace(normal=(0, 0, 1), offset=0.0), name="floor")
    pad = b.add_contact(box, floor, mu=0.5, restitution=0.5, name="pad")
    model = b.finalize(device="cpu", worlds=2)
    model.set_parameter("pad.mu", [0.1, 0.5])
    sim = wf.Simulation(model, dt=1e-3)
    sim.step(5)
    c = sim.contact_record(pad)
    assert c.time.shape == (5,)
    assert c.force.shape == c.moment.shape == (2, 5, 3)
    for values in (c.normal_force, c.penetration, c.slip, c.area, c.stick, c.stored, c.loss, c.friction):
        assert values.shape == (2, 5)
    assert c.collider_work.shape == (2, 5)
    assert sim.contact_force(pad).shape == (2, 6)
    assert model.contact_force(sim.state).shape == (2, model.slots, 3)
    names = ("contact", "contact_loss", "friction", "collider_work")
    assert all(sim.energies()[name].shape == (2,) for name in names)
    assert issubclass(wf.PenetrationError, wf.ConvergenceError)


def test_errors_derive_from_one():
    names = ["MeshError", "ModelError", "ConvergenceError", "ConstraintError", "PenetrationError", "CapacityError"]
    for name in [*names, "CheckpointError", "OutputError"]:
        assert issubclass(getattr(wf, name), wf.Error)


def test_joints():
    steel = wf.SVK(E=7e8, nu=0.33, density=2700.0)
    b = wf.ModelBuilder()
    beam = b.add_beam(
        [(0, 0, 0), (1, 0, 0)], elements=2, section=wf.Rectangle(0.1, 0.1), normal=(0, 0, 1), material=steel
    )
    plate = b.add_shell(
        wf.mesh.grid((1, 1), cells=(2, 2)), thickness=0.1, material=steel, transform=(np.eye(3), (1, 0, 0))
    )
    box = b.add_solid(wf.mesh.box((0.5, 0.5, 0.5), cells=(1, 1, 1)), transform=(np.eye(3), (-0.5, -0.25, -0.25)),
                      material=steel, name="box")  # fmt: skip
    elbow = b.add_joint(
        "revolute",
        parent=beam.end,
        child=plate.at((1, 0, 0)),
        anchor=(1, 0, 0),
        axis=(0, 1, 0),
        drive=None,
        name="elbow",
    )
    P, Q, R, T = beam.start, beam.end, plate.at((1, 0, 0)), plate.at((1, 1, 0))
    right = b.add_constraint("DP1", points=(P, Q, R, T), value=0.0)
    weld = b.weld(beam.start, box.surface("x+"))
    hold = b.add_joint("fixed", parent=wf.GROUND, child=box.surface("x-"))
    assert isinstance(elbow, wf.Joint)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3, constraint_tol=1e-8)
    assert sim.step().violation[0] <= 1e-8 * sim.model.size
    for joint in (elbow, right, weld, hold):
        assert sim.joint_force(joint).shape == (1, 6)
        assert sim.violation(joint).shape == (1,)
        record = sim.joint_record(joint)
        assert record.time.shape == (1,)
        assert record.force.shape == record.moment.shape == (1, 1, 3)
        assert record.violation.shape == (1, 1)
    assert sim.joint_value(elbow).shape == (1,)


def test_parts():
    b = wf.ModelBuilder()
    p = b.add_rigid(wf.Box((0, 0, 0), (0.1, 0.1, 0.1)), density=7800.0, name="p")
    q = b.add_rigid(wf.Box((0.5, 0, 0), (0.1, 0.1, 0.1)), mass=2.0, inertia=(0.1, 0.1, 0.1), com=(0.5, 0, 0), name="q")
    bar = b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1), element="T4"), transform=(np.eye(3), (0, 1, 0)),
                      material=wf.SVK(E=1e6, nu=0.3, density=1000.0))  # fmt: skip
    hinge = b.add_joint(
        "revolute", parent=p.at((0.05, 0, 0)), child=q.at((0.05, 0, 0)), axis=(0, 0, 1),
        limits=wf.Stop(-1.0, 1.0), friction=0.1, stiffness=1.0, damping=0.1,
    )  # fmt: skip
    P, Q = p.at((0, 0, 0.05)), q.at((0.5, 0, 0.05))
    b.add_spring(P, Q, stiffness=10.0, damping=0.0, rest=None, law=None)
    b.add_torsion_spring(hinge, stiffness=1.0)
    b.add_bushing(P, wf.GROUND, stiffness=10.0, damping=0.1)
    b.add_point_mass(bar.surface("y-"), 1.0, inertia=0.0)
    b.add_actuator(hinge, torque=wf.PD(1.0, 0.1, target=wf.Control("q", 1), limit=None))
    b.add_foundation(bar.surface("y+"), stiffness=1e3, damping=1.0)
    b.add_velocity_constraint("speed", b.add_joint("translational", parent=wf.GROUND, child=bar.surface("z-"),
                                                   axis=(1, 0, 0)))  # fmt: skip
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3, integrator="bdf2")
    sim.step()
    assert [x.shape for x in sim.pose(p)] == [(1, 3), (1, 4)]
    assert sim.angular_velocity(p).shape == (1, 3)
    assert sim.joint_rate(hinge).shape == (1,)
    for section in (
        wf.Circle(0.1),
        wf.Tube(0.1, 0.01),
        wf.Section(np.array([(-0.1, 0.0), (0.1, 0.1), (0, -0.1)]), np.ones(3)),
    ):
        assert section


def test_results(tmp_path):
    b = wf.ModelBuilder()
    body = b.add_solid(wf.mesh.box((1, 0.1, 0.1), cells=(2, 1, 1), element="T4"), name="bar",
                       material=wf.SVK(E=1e6, nu=0.3, density=1000.0))  # fmt: skip
    b.clamp(body.nodes("x-"))
    b.add_point_load(body.at((1, 0.05, 0.05)), force=(-1e-3, 0, 0))
    model = b.finalize(device="cpu")
    r = wf.solve_static(model, load_steps=1, unstable="warn", outputs=[wf.VTUWriter(tmp_path / "x")])
    nodes = len(body.mesh.points)
    for name, count in (("cauchy", 6), ("first_piola", 9), ("principal", 3)):
        assert r.field(name, body).shape == (1, nodes, count)
    r.write(tmp_path / "x.vtu")
    assert wf.read_results(tmp_path / "x" / "x.pvd").field("von_mises", "bar").shape[2] == nodes
    assert wf.modes(model, r.state, count=10).frequencies.shape == (10,)
    assert wf.buckling(model, r.state).factors.shape == (1,)
    sim = wf.Simulation(model, dt=1e-3, energy_growth="warn", check_overlap=True)
    history = sim.history("cauchy", body.at((0.5, 0.05, 0.05)))
    sim.run(2e-3, outputs=[wf.HTMLWriter(tmp_path / "x.html")])
    assert history.values.shape == (1, 2, 1, 6)
    assert sim.sample([body.at((0.5, 0.05, 0.05))], "von_mises").shape == (1, 1)
    assert (tmp_path / "x.html").stat().st_size > 1000
    assert callable(wf.mesh.from_surface)
