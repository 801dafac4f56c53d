"""Choice of the solver's methods: a table of decisions, plans that are given, and worlds alone."""

from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pytest

import warpfea as wf
from warpfea.builder.scene import find
from warpfea.solvers import SolverPlan, choose_solver

CPU, CUDA = SimpleNamespace(is_cuda=False), SimpleNamespace(is_cuda=True)
STEEL = wf.SVK(E=2e11, nu=0.3, density=7800.0)


def beam(elements=16, damping=None, **given):
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    material = replace(STEEL, damping=damping) if damping else STEEL
    rod = b.add_beam(
        [(0, 0, 0), (1, 0, 0)], elements=elements, section=wf.Rectangle(0.02, 0.02), normal=(0, 0, 1), material=material
    )
    b.clamp(rod.nodes("start"))
    return b.finalize(**{"device": "cpu"} | given)


def block(cells, hinged=None, **given):
    """`hinged`: a rigid part beside it hangs from "ground" or from the "block"."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    body = b.add_solid(wf.mesh.box((1, 1, 1), cells=cells), material=STEEL)
    b.clamp(body.nodes("x-"))
    if hinged:
        part = b.add_rigid(wf.Box((1.5, 0.5, 0.5), (1, 0.1, 0.1)), density=1e3)
        other = body.at((1, 0.5, 0.5)) if hinged == "block" else wf.GROUND
        b.add_joint("spherical", parent=other, child=part.at((1, 0.5, 0.5)), anchor=(1, 0.5, 0.5))
    return b.finalize(**{"device": "cpu"} | given)


def scene(name, **given):
    return find(name)(**given).finalize(device="cpu")


MODELS = {
    "beam": beam,
    "damped beam": lambda: beam(damping=wf.KelvinVoigt(eta=1e3)),
    "long beam": lambda: beam(elements=200),
    "block": lambda: block((6, 6, 6)),
    "block beside a part": lambda: block((6, 6, 6), "ground"),
    "block with a part": lambda: block((6, 6, 6), "block"),
    "slider": lambda: scene("slider_crank"),
    "chain": lambda: scene("chain", links=40),
}
TABLE = [
    # model, device, many, options, scheme, what the plan has
    ("beam", CPU, False, {}, "dynamics", {"preconditioner": "banded", "operator": "matrix", "matrix_reuse_level": 2}),
    ("block", CPU, False, {}, "dynamics", {"operator": "matrix", "matrix_reuse_level": 2}),
    ("block beside a part", CPU, False, {}, "dynamics", {"operator": "matrix", "matrix_reuse_level": 2}),
    ("block with a part", CPU, False, {}, "dynamics", {"operator": "matrix", "matrix_reuse_level": 0}),
    ("beam", CPU, True, {}, "dynamics", {"preconditioner": "banded", "exact": True, "factors_operator": True}),
    ("beam", CUDA, False, {}, "dynamics", {"preconditioner": "two-level", "operator": "matrix", "exact": False}),
    ("beam", CUDA, True, {}, "dynamics", {"preconditioner": "banded", "exact": True, "matrix_rebuild_cost": 3.0}),
    (
        "beam",
        CUDA,
        False,
        {},
        "statics",
        {"preconditioner": "two-level", "factors_operator": True, "matrix_reuse_level": 0},
    ),
    ("beam", CPU, False, {}, "midpoint", {"krylov": "bicgstab", "operator": "elements", "factors_operator": False}),
    ("beam", CPU, False, {"operator": "elements"}, "statics", {"operator": "predicted stress", "assembles": True}),
    (
        "beam",
        CPU,
        False,
        {"linear": "direct"},
        "dynamics",
        {"preconditioner": "factors", "deflates_constraints": False},
    ),
    ("beam", CPU, False, {"preconditioner_dtype": "float32"}, "dynamics", {"preconditioner": "two-level"}),
    ("beam", CUDA, True, {"preconditioner_dtype": "float32"}, "dynamics", {"preconditioner": "two-level"}),
    ("beam", CPU, False, {"forcing": 1e-8}, "dynamics", {"first_forcing": 1e-8}),
    ("damped beam", CPU, False, {}, "dynamics", {"matrix_reuse_level": 1, "first_forcing": 0.001}),
    ("damped beam", CUDA, False, {}, "dynamics", {"matrix_reuse_level": 0}),
    ("long beam", CUDA, True, {}, "dynamics", {"preconditioner": "two-level", "half_bandwidth": 0}),
    ("block", CPU, False, {}, "dynamics", {"preconditioner": "two-level", "operator": "matrix", "rebuild_cost": 40.0}),
    ("block", CUDA, True, {}, "dynamics", {"preconditioner": "two-level", "operator": "clusters", "assembles": True}),
    ("block", CUDA, False, {"preconditioner": "block-jacobi"}, "dynamics", {"assembles": False, "first_forcing": 0.1}),
    ("slider", CUDA, False, {}, "dynamics", {"preconditioner": "two-level", "deflates_constraints": True}),
    (
        "slider",
        CUDA,
        True,
        {},
        "dynamics",
        {"preconditioner": "banded", "matrix_reuse_level": 0, "factors_operator": True},
    ),
    ("slider", CPU, True, {}, "dynamics", {"preconditioner": "banded", "factors_operator": False}),
    ("chain", CUDA, False, {}, "dynamics", {"preconditioner": "deflated", "first_forcing": 0.01}),
]


@pytest.fixture(scope="module")
def models():
    return {name: make() for name, make in MODELS.items()}


@pytest.mark.parametrize(("name", "device", "many", "options", "scheme", "wanted"), TABLE)
def test_table_of_decisions(models, name, device, many, options, scheme, wanted):
    given = {"options": wf.NewtonPCG(**options), "scheme": scheme}
    plan = choose_solver(models[name], device, many, **given)
    assert {key: getattr(plan, key) for key in wanted} == wanted
    assert choose_solver(models[name], device, many, **given) == plan  # pure
    assert choose_solver(MODELS[name](), device, many, **given) == plan


def test_many_changes_nothing_on_a_cpu(models):
    for model in models.values():
        assert choose_solver(model, CPU, many=True) == choose_solver(model, CPU)


def test_jacobi_takes_no_product(models):
    plan = choose_solver(models["beam"], CPU, options=wf.Jacobi())
    assert (plan.solver, plan.preconditioner, plan.rebuild_cost) == ("jacobi", "two-level", 10.0)
    assert plan.methods == {"solver": "jacobi"}


def test_many_from_64_worlds():
    assert [beam(worlds=worlds).many for worlds in (1, 63, 64)] == [False, False, True]
    assert [beam(worlds=worlds, many=many).many for worlds, many in ((1, True), (64, False))] == [True, False]
    assert beam(worlds=64).resized(1).many
    assert beam(many=True).info()["many"]


def test_the_plan_is_shown(models):
    sim = wf.Simulation(models["beam"], dt=1e-3)
    assert sim.info()["plan"] == {field.name: getattr(sim.plan, field.name) for field in fields(SolverPlan)}
    assert sim.methods == sim.plan.methods


def test_a_world_alone_with_the_plan_of_many_has_its_bits():
    """The plan of many differs from what a lone model takes, as on a GPU."""
    two_level = wf.NewtonPCG(preconditioner="two-level")
    many = beam(worlds=3)
    gravity = np.array([(0.0, 0.0, -9.81), (0.0, 5.0, 0.0), (3.0, 0.0, -1.0)])
    many.set_gravity(gravity)
    sim = wf.Simulation(many, dt=1e-3, solver=two_level)
    sim.step(5)
    alone = beam()
    alone.set_gravity(gravity[1])
    bits = {}
    for name, plan in (("own", None), ("given", sim.plan)):
        single = wf.Simulation(alone, dt=1e-3, plan=plan)
        single.step(5)
        bits[name] = single.state.displacement.numpy()[0].tobytes()
    assert bits["given"] == sim.state.displacement.numpy()[1].tobytes()
    assert bits["own"] != bits["given"]


@pytest.mark.cuda
@pytest.mark.parametrize("name", ["pendulum", "slider_crank"])
def test_on_a_gpu_too(name):
    b = find(name)()
    many = b.finalize(device="cuda:0", worlds=64)
    sim = wf.Simulation(many, dt=1e-3)
    sim.step(5)
    assert sim.plan.preconditioner == "banded"
    model = b.finalize(device="cuda:0")
    assert wf.Simulation(model, dt=1e-3).plan.preconditioner == "two-level"
    for single in (
        wf.Simulation(model, dt=1e-3, plan=sim.plan),
        wf.Simulation(b.finalize(device="cuda:0", many=True), dt=1e-3),
    ):
        single.step(5)
        assert single.state.displacement.numpy()[0].tobytes() == sim.state.displacement.numpy()[63].tobytes()


def test_statics_takes_a_plan_too(models):
    first = wf.solve_static(models["beam"], load_steps=1, solver=wf.NewtonPCG(preconditioner="two-level"))
    again = wf.solve_static(models["beam"], load_steps=1, solver=wf.NewtonPCG(), plan=first.simulation.plan)
    assert again.simulation.plan.preconditioner == "two-level"
    assert (again.state.displacement.numpy() == first.state.displacement.numpy()).all()


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        ({"preconditioner": "deflated"}, {}, "half_bandwidth = 5 does not fit this simulation, which takes 0"),
        ({}, {"preconditioner": "two-level"}, "preconditioner = 'banded' does not fit"),
        ({}, {"forcing": 1e-6}, "first_forcing = 0.001 does not fit"),
        ({"scheme": "statics"}, {}, "scheme = 'statics' does not fit this simulation, which takes 'dynamics'"),
        ({"dtype": "float32"}, {}, "dtype = 'float32' does not fit"),
        ({"on_cuda": True}, {}, "on_cuda = True does not fit"),
        ({"matrix_reuse_level": 1}, {}, "matrix_reuse_level = 1 does not fit this simulation, which takes 2"),
    ],
)
def test_a_plan_that_does_not_fit_is_refused(models, change, options, message):
    plan = replace(choose_solver(models["beam"], CPU), **change)
    with pytest.raises(wf.ModelError, match=message):
        wf.Simulation(models["beam"], dt=1e-3, solver=wf.NewtonPCG(**options), plan=plan)


def test_plans_of_other_models_are_refused(models):
    plan = choose_solver(models["long beam"], CPU, options=wf.NewtonPCG(preconditioner="two-level"))
    with pytest.raises(wf.ModelError, match=r"plan: .* does not fit this simulation"):
        wf.Simulation(models["slider"], dt=1e-3, plan=plan)
    with pytest.raises(wf.ModelError, match="plan = 'banded' must be a SolverPlan"):
        wf.Simulation(models["beam"], dt=1e-3, plan="banded")
