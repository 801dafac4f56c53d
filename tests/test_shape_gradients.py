"""Derivatives by the reference values, "mesh.X", against differences of models built anew."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import parameter_models as models
import pytest
from gradient_models import POINTS, SOLVER, TARGET, WEIGHTS, linked

import warpfea as wf
from warpfea.simulation.initial_adjoint import check_names
from warpfea.terms.shape_gradients import MeshGradient

LENGTH = 1e-3
"""Of the differences, over the size of an element."""
STEPS = 4


def moved(body, shift, seed=3):
    """Direction (slots, 3) of change of the reference values of a body, and the body changed by a multiple of it."""
    size = 0.01 * (body.slot_kind == 0) + 0.5 * (body.slot_kind > 0)
    direction = size[:, None] * np.random.default_rng(seed).standard_normal((body.slot_count, 3))
    body.__dict__["reference"] = body.reference + shift * direction
    return direction


def solid(b, shift, element, bulge, form="incremental"):
    """A bar of T4 or T10 by the nodes of its mesh, turned at one end."""
    mesh = wf.mesh.box((0.1, 0.02, 0.02), cells=(3, 1, 1), element=element)
    x = mesh.points + bulge * np.sin(np.pi * mesh.points[:, :1] / 0.1) * [0.0, 0.0, 1.0]
    direction = 0.01 * np.random.default_rng(3).standard_normal(x.shape)
    mesh = replace(mesh, points=x + shift * direction, node_sets={"x-": mesh.nodes("x-")})
    law = models.material(models.SVK if element == "T4" else models.NEO, form=form)
    body = b.add_solid(mesh, material=law, name="body")
    turn = wf.Rotation(anchor=(0, 0, 0), axis=(0.2, 1, 0), angle=([0.0, 1.0], [0.0, 30.0]))
    b.drive(body.nodes("x-"), rotation=turn)
    return body, body.surface(np.column_stack([[2, 2], [0, 1]])), direction[body.slot_node]


def cases():
    """By name: the body, the surface under traction and with the probe, and the direction."""

    def beam(b, shift):
        body = b.add_beam(lambda s: (0.1 * s, 0.01 * s * s, 0), elements=2, section=wf.Rectangle(0.01, 0.02),
                          normal=(0, 0, 1), material=models.material(), name="body")  # fmt: skip
        direction = moved(body, shift)
        b.clamp(body.start)
        return body, body.surface("end"), direction

    def shell(b, shift):
        mesh = wf.mesh.grid((0.1, 0.05), cells=(2, 1))
        bent = replace(mesh, points=mesh.points + 2.0 * mesh.points[:, :1] ** 2 * [0, 0, 1])
        body = b.add_shell(bent, thickness=0.01, material=models.material(), name="body")
        direction = moved(body, shift)
        b.clamp(body.edge("x-"))
        return body, body.surface("x+"), direction

    def ancf(b, shift):
        mesh = wf.mesh.box((0.1, 0.04, 0.04), cells=(2, 1, 1), element="H3843")
        body = b.add_solid(mesh, material=models.material(), name="body")
        direction = moved(body, shift)
        b.clamp(body.nodes("x-"))
        return body, body.surface("x+"), direction

    slow = pytest.mark.slow
    return [
        pytest.param(lambda b, shift: solid(b, shift, "T4", 0.0), "backward_euler", id="T4"),
        pytest.param(lambda b, shift: solid(b, shift, "T4", 0.0, "rate"), "bdf2", id="T4 rate", marks=slow),
        pytest.param(lambda b, shift: solid(b, shift, "T10", 0.003), "backward_euler", id="curved T10", marks=slow),
        pytest.param(beam, "backward_euler", id="3243"),
        pytest.param(beam, "generalized_alpha", id="3243 generalized_alpha", marks=slow),
        pytest.param(shell, "energy_momentum", id="3443 energy_momentum", marks=slow),
        pytest.param(ancf, "backward_euler", id="H3843", marks=slow),
    ]


def run(make, shift, mode="gradient", scheme="backward_euler", steps=STEPS):
    """Loss of a run or an equilibrium of a changed body; with `mode` the derivatives and the direction too."""
    b = wf.ModelBuilder(gravity=(0.0, 3.0, -9.81))
    body, end, direction = make(b, shift)
    b.add_traction(end, ((0.0, 1.0), ((0.0, 0.0, 0.0), (3e6, 2e6, -5e6))))
    b.add_probe("tip", end)
    m = b.finalize(device="cpu", many=False)
    tape = wf.Adjoint(wf.Simulation(m, dt=2e-3, integrator=scheme, solver=SOLVER), "mesh.X")
    tape.run(steps)
    probe = tape.probe("tip")
    loss = probe_loss(probe)
    if mode == "loss":
        return loss
    return loss, tape.backward()["mesh.X"].numpy()[0], direction


def probe_loss(probe):
    """Sum of weighted positions, displacements and velocities; writes its derivatives."""
    total = 0.0
    for seed, array in enumerate((probe.displacement, probe.velocity, probe.position)):
        weights = np.random.default_rng(seed).standard_normal(array.shape)
        values = array.numpy()
        total += np.sum(weights * (values + TARGET * values**2))
        array.grad.assign(weights * (1.0 + 2.0 * TARGET * values))
    return total


@pytest.mark.parametrize(("make", "scheme"), cases())
def test_gradient_by_the_reference(make, scheme):
    _, g, direction = run(make, 0.0, scheme=scheme)
    exact = np.sum(g * direction)
    losses = np.array([run(make, LENGTH * point, "loss", scheme) for point in POINTS])
    assert losses @ WEIGHTS / LENGTH == pytest.approx(exact, rel=1e-7)


def test_thickness_of_a_cantilever():
    """Height h of the section through the gradient slots along it: those of a model with another h, and near -3."""

    def tip(height):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        beam = b.add_beam([(0, 0, 0), (0.2, 0, 0)], elements=3, section=wf.Rectangle(0.01, height), normal=(0, 0, 1),
                          material=models.material(), name="body")  # fmt: skip
        b.clamp(beam.start, slots="all")
        b.add_point_load(beam.end, force=(0, 0, 1e-5))
        b.add_probe("tip", beam.end)
        m = b.finalize(device="cpu", worlds=2)
        m.set_parameter("body.E", [1e6, 2e6])
        return beam, wf.solve_static(m, load_steps=1, tol=1e-12)

    beam, result = tip(0.004)
    tape = wf.Adjoint(result, ["mesh.X"])
    tape.probe("tip").displacement.grad.assign(np.tile([0.0, 0.0, 1.0], (2, 1, 1)))
    g = tape.backward()["mesh.X"].numpy()
    values = result.probe("tip").displacement[:, -1, 2]
    rate = np.sum(g * beam.reference * (beam.slot_kind == 3)[:, None], axis=(1, 2)) / values
    others = [tip(0.004 * (1.0 + LENGTH * x))[1].probe("tip").displacement[:, -1, 2] for x in POINTS]
    assert rate == pytest.approx(WEIGHTS @ np.array(others) / LENGTH / values, rel=1e-8)
    assert rate == pytest.approx(-3.0, abs=3e-3)


def test_length_width_and_thickness_of_a_beam_bent_by_a_couple():
    """Two forces F at the faces of its end bend it by w = 6 F L^2 / (E b h^2), without shear."""
    b, height, F = wf.ModelBuilder(gravity=(0, 0, 0)), 0.004, 1e-7
    beam = b.add_beam([(0, 0, 0), (0.2, 0, 0)], elements=3, section=wf.Rectangle(0.01, height), normal=(0, 0, 1),
                      material=wf.SVK(E=1e6, nu=0.0, density=1000.0), name="body")  # fmt: skip
    b.clamp(beam.start, slots="all")
    for side in (1.0, -1.0):
        b.add_point_load(beam.at((0.2, 0, 0.5 * side * height)), force=(side * F, 0, 0))
    b.add_probe("tip", beam.end)
    tape = wf.Adjoint(wf.solve_static(b.finalize(device="cpu"), load_steps=1, tol=1e-12), ["mesh.X", "body.E"])
    w = tape.probe("tip").displacement.numpy()[0, 0, 2]
    assert w == pytest.approx(-6.0 * F * 0.2**2 / (1e6 * 0.01 * height**2), rel=1e-8)
    tape.probe("tip").displacement.grad.assign([[[0.0, 0.0, 1.0]]])
    g = tape.backward()
    by_slot = np.sum(g["mesh.X"].numpy()[0] * beam.reference, axis=1) / w
    powers = [by_slot[beam.slot_kind == kind].sum() for kind in range(4)]
    assert powers == pytest.approx([2.0, 0.0, -1.0, -2.0], abs=1e-8)
    assert g["body.E"].numpy() * 1e6 / w == pytest.approx(-1.0, rel=1e-8)


def test_terms_without_a_derivative_are_refused_by_name():
    ctx = SimpleNamespace(inertia=True, midpoint=False, dissipation=0.0)
    ctx.model = linked("motor")
    with pytest.raises(wf.ModelError, match=r"'mesh.X' has no derivative with 'constraints'"):
        MeshGradient(ctx)
    ctx.model = models.varied(models.beam())
    with pytest.raises(wf.ModelError, match=r"nu of beams and shells .* differs between worlds"):
        MeshGradient(ctx)
    b = wf.ModelBuilder()
    box = b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1), element="T4"), material=models.material())
    turn = wf.Rotation(anchor=(0, 0, 0), axis=(0, 0, 1), angle=([0, 1], [0, 3.0]))
    b.drive(box.nodes("x-"), rotation=turn)
    with pytest.raises(wf.ModelError, match=r"'mesh.X' has no derivative with rotations"):
        check_names(SimpleNamespace(model=b.finalize(device="cpu")), ["mesh.X"])
    ctx.model, ctx.midpoint = models.model(models.solid("T4"), models.material(models.NEO)), True
    with pytest.raises(wf.ModelError, match="'elements': steps of energy_momentum but"):
        MeshGradient(ctx)
