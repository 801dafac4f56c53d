"""Features that a scene does not use cost nothing: no launches, modules or bytes."""

import numpy as np
import pytest
import warp as wp
from warpfea.kernels.terms.springs import spring_kernels

import warpfea as wf


@wp.func
def nothing(x: wp.vec3d, t: wp.float64) -> wp.vec3d:
    return wp.vec3d()


ELEMENTS = wf.NewtonPCG(operator="elements")
"""Without the memory of a matrix that is kept over steps, which damping and joints end."""


def cost(feature=None, **simulation):
    b = wf.ModelBuilder(gravity=(0, 0, -9.81) if feature == "gravity" else (0, 0, 0))
    kelvin = {f: wf.KelvinVoigt(1.0, 1.0, form=f) for f in ("incremental", "explicit", "rate")}
    law = wf.SVK(E=1e6, nu=0.3, density=1000.0, damping=kelvin.get(feature))
    mesh = wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1))
    body = b.add_solid(mesh, material=law, name="box")
    if feature != "free group":
        b.clamp(body.nodes("x-"))
    if feature == "traction":
        b.add_traction(body.surface("x+"), (1.0, 0, 0))
    if feature == "pressure":
        b.add_pressure(body.surface("x+"), 1.0)
    if feature == "field":
        b.add_body_force(nothing)
    if feature == "drive":
        b.drive(body.nodes("x+"), displacement=(0, 0, 0))
    if feature == "rotation":
        b.drive(body.nodes("x+"), rotation=wf.Rotation((0, 0, 0), (1, 0, 0), 0.0))
    if feature == "joint":
        b.add_joint("distance", parent=wf.GROUND, child=body.at((1, 0.1, 0.1)), anchor=(1, 0.1, 2))
    if feature == "hinge":
        b.add_joint("revolute", parent=wf.GROUND, child=body.at((1, 0.1, 0.1)), axis=(0, 1, 0))
    if feature == "spring":
        b.add_spring(body.at((1, 0.1, 0.1)), (1, 0.1, 2), stiffness=1.0)
    if feature in ("contact", "friction"):
        floor = b.add_collider(wf.HalfSpace((0, 0, 1), -1.0))
        b.add_contact(body, floor, mu=0.5 if feature == "friction" else 0.0)
    if feature == "probe":
        b.add_probe("p", body.surface("x+"))
    if feature == "second body":
        other = b.add_solid(mesh, material=law, name="other")
        b.clamp(other.nodes("x-"))
    if feature == "second law":
        other = b.add_solid(mesh, material=wf.NeoHookean(mu=1e6, k=1e6, density=1000.0), name="other")
        b.clamp(other.nodes("x-"))
    model = b.finalize(device="cpu")
    sim = wf.Simulation(model, dt=1e-3, **simulation)
    launch = sim.stepper.launch
    names = frozenset(module.name for module in sim.stepper.modules())
    kernels = frozenset(k.rsplit(".", 1)[1] for k in launch.kernels)
    return launch.launches, kernels, names, sum(sim.bytes().values()), model


FEATURES = ["gravity", "incremental", "explicit", "rate", "free group", "traction", "pressure", "field", "drive"]
FEATURES += ["joint", "spring", "contact", "friction", "rotation", "probe", "second body", "second law"]


@pytest.mark.parametrize("feature", FEATURES)
def test_a_feature_comes_and_goes_without_trace(feature):
    default = cost()
    cost(feature)
    assert cost()[:4] == default[:4]
    bare = cost(solver=ELEMENTS)
    with_it = cost(feature, solver=ELEMENTS)
    again = cost(solver=ELEMENTS)
    assert again[:4] == bare[:4]
    assert with_it[3] > bare[3] or feature in ("gravity", "rate")
    if feature not in ("rate", "second body"):
        assert with_it[0] > bare[0]
        assert with_it[1] > bare[1] or feature in ("incremental", "explicit", "second law")
    assert with_it[4].info()["left_out"] != bare[4].info()["left_out"] or feature in ("probe", "second law")


def test_options_of_the_simulation_come_and_go():
    bare = cost(ledger=False)
    full = cost()
    assert full[0] > bare[0]
    assert full[3] > bare[3]
    assert cost(ledger=False)[:4] == bare[:4]
    multistep = cost(integrator="bdf2")
    assert multistep[3] > full[3]
    no_halving = cost(solver=wf.NewtonPCG(max_halvings=0))
    assert no_halving[0] == full[0]  # copies are made where a step was refused alone
    assert [name.rpartition(".")[2] for name in full[2] - no_halving[2]] == ["state"]
    assert no_halving[3] < full[3]


def test_bare_step_uses_few_modules():
    _, kernels, modules, _, model = cost(ledger=False)
    assert len(modules) <= 13
    assert not any("follower" in k or "drive" in k or "evaluate_time_laws" in k or "dead_load" in k for k in kernels)
    assert not any("constraint" in name or "contact" in name for name in modules)
    assert {"constraints", "gravity", "body forces", "follower pressure", "driven nodes"} <= set(
        model.info()["left_out"]
    )


def test_a_scene_without_contact_has_nothing_of_it():
    launches, kernels, modules, _, model = cost()
    more, with_kernels, with_modules, _, touching = cost("contact")
    assert not any("contact" in name for name in modules)
    assert any("contact" in name for name in with_modules)
    assert not {name for name in model.memory.bytes if "contact" in name}
    assert "contact" in touching.memory.bytes
    assert {"contact", "friction"} <= set(model.info()["left_out"])
    assert "contact" not in touching.info()["left_out"]
    assert more > launches
    assert len(with_kernels - kernels) >= 10


def test_turns_are_counted_with_the_multipliers():
    """Of angles that no drive prescribes: in the launch that stores the multipliers."""
    launches, kernels, modules, _, _ = cost("joint")
    turns, with_kernels, with_modules, _, _ = cost("hinge")
    assert not any("joint_angles" in name for name in modules)
    assert any("joint_angles" in name for name in with_modules)
    assert (kernels - with_kernels, with_kernels - kernels) == ({"store_multipliers"}, {"store_with_angles"})
    assert turns == launches


def test_plain_springs_have_nothing_of_actuators_and_bushings():
    """No module with bounded laws or chords, and no array that only these read."""
    _, _, modules, _, model = cost("spring")
    names = [name for name in modules if "spring" in name]
    assert names
    assert not any(word in name for word in ("bounded", "chords") for name in names)
    assert not hasattr(spring_kernels(model.dtype, midpoint=False), "find_impacts")
    arrays = {name for name in model.terms.parameter_arrays() if name.startswith("springs.")}
    assert arrays == {"springs.stiffness", "springs.damping", "springs.rest_coordinate"}


def test_gravity_without_a_law_launches_no_law():
    _, kernels, modules, _, _ = cost("gravity")
    assert not any("gravity" in name for name in (*modules, *kernels))


def test_table_path_only_where_elements_are_curved():
    b = wf.ModelBuilder()
    b.add_solid(wf.mesh.sphere(1.0, cells=4), material=wf.SVK(E=1e6, nu=0.3, density=1000.0))
    kinds = {block["affine"] for block in b.finalize(device="cpu").info()["blocks"]}
    assert kinds == {True, False}
    assert np.isfinite(b.finalize(device="cpu").info()["mass"])
