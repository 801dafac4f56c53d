"""Constants of materials that differ between worlds: each world equals a run of its own, bit for bit."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from parameter_models import CASES, NEO, NU, RHO, SVK, VALUES, E, beam, material, model, rows, solid, varied

import warpfea as wf


def alone_with(case, world, dtype="float64", names=tuple(VALUES)):
    """One world, built with the values of a world; a tied beam has them set, as E/mu in it may round another way."""
    add, law = CASES[case]
    values = {name: VALUES[name][world] for name in names}
    if case != "3243":
        return model(add, material(**values, **law), dtype=dtype)
    out = model(add, material(**law), dtype=dtype)
    for name, value in reversed(values.items()):
        out.set_parameter(f"body.{name}", value)
    return out


@pytest.mark.parametrize(
    ("case", "dtype"),
    [
        # five modules of their own each
        *(
            pytest.param(case, "float64", marks=[pytest.mark.slow] if case in ("3243 full", "3443 full") else [])
            for case in CASES
        ),
        ("T10", "float32"),
        *(pytest.param(case, "float32", marks=pytest.mark.slow) for case in ("3243", "3443")),
    ],
)
def test_each_world_equals_a_run_built_with_its_values(case, dtype):
    add, law = CASES[case]
    many = varied(add, dtype=dtype, **law)
    sim = wf.Simulation(many, dt=2e-3)
    sim.step(4)
    assert len({rows(sim, world)["displacement"] for world in range(3)}) == 3
    for world in range(3):
        single = alone_with(case, world, dtype)
        alone = wf.Simulation(single, dt=2e-3)
        alone.step(4)
        assert rows(sim, world) == rows(alone, 0), world
        one, other = many.tangent_matrix(sim.state, world), single.tangent_matrix(alone.state)
        assert (one != other).nnz == 0
        stress = sim.field("von_mises", many.bodies[0])[world]
        assert np.array_equal(stress, alone.field("von_mises", single.bodies[0])[0])


@pytest.mark.parametrize("integrator", ["bdf2", "energy_momentum", "generalized_alpha"])
@pytest.mark.parametrize("case", ["T10", "3443"])
def test_of_other_integrators(case, integrator):
    add, law = CASES[case]
    sim = wf.Simulation(varied(add, **law), dt=2e-3, integrator=integrator)
    sim.step(4)
    for world in range(3):
        alone = wf.Simulation(alone_with(case, world), dt=2e-3, integrator=integrator)
        alone.step(4)
        assert rows(sim, world) == rows(alone, 0), world


@pytest.mark.parametrize("linear", ["pcg", "direct"])
@pytest.mark.parametrize("case", ["T10", "3243", "3443"])
def test_statics(case, linear):
    add, law = CASES[case]
    solver = wf.NewtonPCG(max_newton=50, linear=linear)
    found = wf.solve_static(varied(add, names=("E", "nu"), **law), load_steps=2, solver=solver)
    for world in range(3):
        alone = wf.solve_static(alone_with(case, world, names=("E", "nu")), load_steps=2, solver=solver)
        assert rows(found.simulation, world) == rows(alone.simulation, 0)


def test_the_tip_follows_the_modulus():
    """Small deflections go as 1/E: the values reach the right worlds."""
    many = model(beam(), material(), worlds=3, gravity=(0.0, 0.0, -1e-3))
    many.set_parameter("body.E", E)
    tip = wf.solve_static(many, load_steps=1, tol=1e-10).probe("tip").displacement[:, -1, 2]
    assert tip * E == pytest.approx(np.full(3, tip[0] * E[0]), rel=1e-5)


def test_constants_of_a_law_of_its_own_numbers():
    """mu10, mu01, k; and lambda_v."""

    def build(law, worlds=1):
        return model(solid(), law, worlds)

    def law(mu10, mu01, k, lambda_v):
        return wf.MooneyRivlin(mu10=mu10, mu01=mu01, k=k, density=1e3, damping=wf.KelvinVoigt(5.0, lambda_v))

    values = {"mu10": [2e5, 3e5], "mu01": [0.0, 1e5], "k": [1e6, 2e6], "lambda_v": [0.0, 40.0]}
    many = build(law(1e5, 1e5, 1e7, 3.0), worlds=2)
    for name, value in values.items():
        many.set_parameter(f"body.{name}", value)
    sim = wf.Simulation(many, dt=2e-3)
    sim.step(3)
    for world in range(2):
        alone = wf.Simulation(build(law(*(value[world] for value in values.values()))), dt=2e-3)
        alone.step(3)
        assert rows(sim, world) == rows(alone, 0)


def grouped(worlds=1, arm=(1e6, 0.3), pad=(4e5, 0.4)):
    mesh = wf.mesh.box((0.1, 0.02, 0.02), cells=(4, 1, 1))
    left = mesh.points[mesh.cells].mean(axis=1)[:, 0] < 0.05
    groups = {"arm": np.flatnonzero(left), "pad": np.flatnonzero(~left)}
    mesh = replace(mesh, element_sets=groups)
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    laws = {"arm": SVK(E=arm[0], nu=arm[1], density=1e3), "pad": NEO(E=pad[0], nu=pad[1], density=1e3)}
    body = b.add_solid(mesh, material=laws, name="hook")
    b.clamp(body.nodes("x-"))
    return b.finalize(device="cpu", worlds=worlds)


def test_groups_and_whole_bodies():
    many = grouped(worlds=2)
    many.set_parameter("hook.arm.E", [1e6, 3e6])
    many.set_parameter("hook.nu", [0.1, 0.2])
    sim = wf.Simulation(many, dt=2e-3)
    sim.step(3)
    for world, (E_arm, nu) in enumerate(((1e6, 0.1), (3e6, 0.2))):
        alone = wf.Simulation(grouped(arm=(E_arm, nu), pad=(4e5, nu)), dt=2e-3)
        alone.step(3)
        assert rows(sim, world) == rows(alone, 0)


@pytest.mark.parametrize("two", [False, True])
def test_the_stiffness_of_contacts_follows(two):
    """A block on a floor, and on another body: k_n, k_t and the damping are those of the world's E and nu."""

    def build(worlds=1):
        b = wf.ModelBuilder(gravity=(0, 0, -9.81))
        block = b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1)), material=material(), name="body")
        b.set_initial(block, velocity=(0.5, 0, -0.1))
        if two:
            mesh = wf.mesh.box((0.2, 0.2, 0.05), cells=(2, 2, 1))
            mesh = replace(mesh, points=mesh.points - [0.05, 0.05, 0.05])
            other = b.add_solid(mesh, material=SVK(E=2e6, nu=0.3, density=1e3), name="table")
            b.clamp(other.nodes("z-"))
        else:
            other = b.add_collider(wf.HalfSpace(normal=(0, 0, 1)), name="floor")
        b.add_contact(block, other, mu=0.3, restitution=0.3, name="pad")
        return b.finalize(device="cpu", worlds=worlds)

    def run(model, values):
        for name, value in values.items():
            model.set_parameter(f"body.{name}", value)
        sim = wf.Simulation(model, dt=1e-3)
        sim.step(12)
        return sim

    sim = run(build(3), {"E": E, "nu": NU})
    force = sim.contact_record("pad").normal_force.max(axis=1)
    assert len(set(force)) == 3
    assert np.all(force > 0.0)
    for world in range(3):
        alone = run(build(), {"E": E[world], "nu": NU[world]})
        assert rows(sim, world) == rows(alone, 0), world
    term = sim.model.terms.contacts[-1]
    ratio = term.tables.data.normal_stiffness.numpy()[:, 0] / term.tables.data.normal_stiffness.numpy()[0, 0]
    stiff = E / (1.0 - NU**2)
    if two:
        stiff = 1.0 / (1.0 / stiff + (1.0 - 0.3**2) / 2e6)
    assert ratio == pytest.approx(stiff / stiff[0], rel=1e-12)


@pytest.mark.parametrize("case", ["T10", "3443"])
def test_a_change_in_a_run_reaches_the_chosen_worlds_alone(case):
    """Through recorded graphs, from the host and from a device; the ledger has the jump as work."""
    add, law = CASES[case]

    def run(worlds, values, mask):
        m = varied(add, worlds=3, **law) if worlds > 1 else model(add, material(**law))
        if worlds == 1:
            for name, value in values[0].items():
                m.set_parameter(f"body.{name}", value)
        sim = wf.Simulation(m, dt=2e-3)
        sim.step(3)
        graph, tables = sim.stepper.graph, [block.data.coefficients.ptr for block in m.blocks]
        if values[1]:
            for name, value in values[1].items():
                m.set_parameter(f"body.{name}", value, mask=mask)
        sim.step(3)
        assert sim.stepper.graph is graph
        assert [block.data.coefficients.ptr for block in m.blocks] == tables
        return sim

    new = {
        "E": wp.array([np.nan, 5e6, 3e5], dtype=wp.float64, device="cpu"),
        "nu": np.array([9.0, 0.1, 0.33]),
        "eta": 5,
        "density": 700.0,
    }
    many = run(3, (None, new), wp.array([False, True, True], dtype=wp.bool, device="cpu"))
    for world in range(3):
        first = {name: values[world] for name, values in VALUES.items()}
        second = (
            {"E": (5e6, 3e5)[world - 1], "nu": (0.1, 0.33)[world - 1], "eta": 5.0, "density": 700.0} if world else {}
        )
        alone = run(1, (first, second), None)
        assert rows(many, world) == rows(alone, 0), world
    energy = many.energies()
    change = energy["kinetic"] + energy["strain"] + energy["potential"] - energy["work"]
    lost = energy["viscous"] + energy["integrator"]
    assert change + lost == pytest.approx(energy["ledger_residual"], abs=1e-12)
    assert np.all(np.abs(energy["work_fields"][1:]) > 1e-9)
    assert energy["work_fields"][0] == 0.0


def test_reset_takes_the_values_there_are():
    add, law = CASES["T10"]
    sim = wf.Simulation(varied(add, **law), dt=2e-3)
    sim.step(2)
    sim.model.set_parameter("body.E", 4e6, mask=[False, True, False])
    sim.reset([False, True, False])
    sim.step(3)
    fresh = wf.Simulation(varied(add, **law), dt=2e-3)
    fresh.model.set_parameter("body.E", 4e6, mask=np.array([0, 1, 0]))
    fresh.step(3)
    one, other = rows(sim, 1), rows(fresh, 1)
    assert one == other


def test_damping_of_zero_stays_a_feature():
    m = model(solid(), material(eta=0.0), worlds=2)
    m.set_parameter("body.eta", [0.0, 40.0])
    sim = wf.Simulation(m, dt=2e-3)
    sim.step(3)
    alone = wf.Simulation(model(solid(), material(eta=40.0)), dt=2e-3)
    alone.step(3)
    assert rows(sim, 1) == rows(alone, 0)


def test_a_checkpoint_holds_the_values(tmp_path):
    add, law = CASES["3443"]
    path = tmp_path / "c.npz"

    def start():
        sim = wf.Simulation(varied(add, **law), dt=2e-3)
        sim.step(2)
        return sim

    sim = start()
    sim.model.set_parameter("body.nu", 0.41, mask=[True, False, False])
    sim.step(1)
    sim.run(sim.time[0], outputs=[wf.Checkpoint(path)])
    sim.step(3)
    other = start()
    other.resume(path)
    other.step(3)
    for world in range(3):
        assert rows(sim, world) == rows(other, world)
    assert np.array_equal(other.model.parameters.numpy()["body.0.nu"], [0.41, 0.45, 0.2])
    with np.load(path) as file:
        damaged = dict(file)
    damaged["parameter.body.0.nu"] = np.array([0.3, 0.6, 0.3])
    np.savez(tmp_path / "d.npz", **damaged)
    before = rows(other, 0)
    with pytest.raises(wf.CheckpointError, match=r"'body.0.nu' are damaged"):
        other.resume(tmp_path / "d.npz")
    assert rows(other, 0) == before
    for names in ((), ("E", "eta")):
        without = wf.Simulation(varied(add, names=names, **law), dt=2e-3)
        before = rows(without, 0)
        with pytest.raises(wf.CheckpointError, match=r"checkpoint has values of 'body\..*' set, the model has not"):
            without.resume(path)
        assert rows(without, 0) == before


def test_masses_are_those_of_the_densities():
    """Of a body with two groups, one of which has a density that varies in space and is scaled."""

    def build(first, second, worlds=1):
        b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
        mesh = wf.mesh.box((0.1, 0.02, 0.02), cells=(4, 1, 1), element="T4")
        left = mesh.points[mesh.cells].mean(axis=1)[:, 0] < 0.05
        mesh = replace(mesh, element_sets={"left": np.flatnonzero(left), "right": np.flatnonzero(~left)})
        laws = {
            "left": wf.SVK(E=1e6, nu=0.3, density=first),
            "right": wf.NeoHookean.from_E_nu(E=2e6, nu=0.4, density=second),
        }
        b.add_solid(mesh, material=laws, name="body")
        return b.finalize(device="cpu", worlds=worlds)

    def graded(X):
        return 800.0 + 1e4 * X[:, 0]

    many = build(1000.0, graded, 2)
    assert many.info()["mass"] == pytest.approx(build(1000.0, graded).info()["mass"], rel=1e-14)
    many.set_parameter("body.left.density", [1000.0, 1700.0])
    many.set_parameter("body.right.density_factor", [1.0, 3.0])
    sim = wf.Simulation(many, dt=1e-3)
    sim.step(3)
    for world, (first, factor) in enumerate(((1000.0, 1.0), (1700.0, 3.0))):
        single = build(first, lambda X, factor=factor: factor * graded(X))
        one, other = many.mass_matrix(world), single.mass_matrix()
        assert abs(one - other).max() <= 1e-14 * abs(other).max()
        alone = wf.Simulation(single, dt=1e-3)
        alone.step(3)
        kinetic = alone.energies()["kinetic"][0]  # a free fall: half of m v^2
        assert kinetic == pytest.approx(0.5 * single.mass * (9.81 * 3e-3) ** 2, rel=1e-9)
        assert sim.energies()["kinetic"][world] == pytest.approx(kinetic, rel=1e-12)


@pytest.mark.parametrize("solver", [wf.NewtonPCG(preconditioner="two-level"), wf.Jacobi()], ids=["two-level", "jacobi"])
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_free_bodies_of_other_densities(solver, dtype):
    """A free body, whose translation is solved for by its mass, falls onto a plane."""

    def build(density, worlds=1):
        b = wf.ModelBuilder(gravity=(0.1, 0.0, -9.81))
        mesh = wf.mesh.box((0.04, 0.04, 0.04), cells=(1, 1, 1), origin=(0.0, 0.0, 1e-4))
        body = b.add_solid(mesh, material=wf.NeoHookean.from_E_nu(E=1e6, nu=0.3, density=density), name="body")
        b.add_contact(body.surface("z-"), b.add_collider(wf.HalfSpace(normal=(0, 0, 1))), mu=0.3, name="floor")
        return b.finalize(device="cpu", worlds=worlds, dtype=dtype)

    many = build(1000.0, 2)
    many.set_parameter("body.density", RHO[:2])
    sim = wf.Simulation(many, dt=2e-3, solver=solver)
    sim.step(4)
    for world in range(2):
        alone = wf.Simulation(build(RHO[world]), dt=2e-3, solver=solver)
        alone.step(4)
        assert rows(sim, world) == rows(alone, 0), world
