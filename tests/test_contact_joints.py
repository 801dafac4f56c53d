"""Contact and joints in one model."""

import numpy as np
import pytest

import warpfea as wf

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
SOFT, STIFF = (wf.SVK(E=E, nu=0.3, density=1000.0) for E in (1e6, 1e8))


def sliding(jointed, device, velocity, multipliers):
    """A cube that slides on a floor and, elsewhere, one that is clamped at one face and on a joint at the other."""
    b = wf.ModelBuilder()
    block = b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1)), material=SOFT, name="block")
    b.set_initial(block, velocity=velocity)
    b.add_contact(block.surface("z-"), b.add_collider(wf.HalfSpace((0, 0, 1))), mu=0.5, restitution=0.5, name="pad")
    held = b.add_solid(wf.mesh.box((0.02,) * 3, cells=(1, 1, 1), origin=(0, 0, 1)), material=STIFF, name="held")
    b.clamp(held.nodes("x-"))
    if jointed:
        b.add_joint("spherical", parent=wf.GROUND, child=held.surface("x+"), name="joint")
    solver = wf.NewtonPCG(tol=1e-10, max_halvings=0, multipliers=multipliers)
    sim = wf.Simulation(b.finalize(device=device), dt=2.5e-3, solver=solver)
    sim.step(6)
    return sim, block


@pytest.mark.parametrize("velocity", [(0, 0, 0), (1, 0, 0), (1, 0, -0.5)], ids=str)
@pytest.mark.parametrize("multipliers", ["newton", "outer"])
@pytest.mark.parametrize("device", DEVICES)
def test_a_joint_elsewhere_does_not_change_a_contact(device, multipliers, velocity):
    (sim, block), (plain, other) = (sliding(jointed, device, velocity, multipliers) for jointed in (True, False))
    assert sim.positions(block) == pytest.approx(plain.positions(other), abs=1e-9)
    assert sim.totals["newton"][0] <= 2 * plain.totals["newton"][0]
    assert sim.violation("joint")[0] < 1e-8


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("place", [0.9, 1.0])
def test_a_hinged_bar_lies_on_its_stop_with_its_weight_by_the_lever(device, place):
    b = wf.ModelBuilder()
    bar = b.add_solid(wf.mesh.box((1, 0.1, 0.1), cells=(6, 1, 1)), material=STIFF, name="bar")
    b.add_joint("revolute", parent=wf.GROUND, child=bar.surface("x-"), axis=(0, 1, 0), name="hinge")
    stop = b.add_collider(wf.Sphere((place, 0.05, -0.05), 0.05), name="stop")
    b.add_contact(bar.surface("z-"), stop, restitution=0.2, name="pad")  # friction would turn it about the hinge
    model = b.finalize(device=device)
    sim = wf.Simulation(model, dt=5e-3, solver=wf.NewtonPCG(tol=1e-10))
    sim.step(300)
    weight = 9.81 * model.mass
    contact, hinge = sim.contact_force("pad")[0], sim.joint_force("hinge")[0]
    assert contact[2] == pytest.approx(0.5 / place * weight, rel=5e-3)  # it sags
    assert contact[:3] + hinge[:3] == pytest.approx(np.array([0.0, 0.0, weight]), abs=1e-3 * weight)
    assert abs(sim.energies()["ledger_residual"][0]) < 1e-8
