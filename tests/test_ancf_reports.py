"""ANCF bodies in a scene: initial values, reports, drawing, fields."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from ancf_bodies import (
    BODIES,
    RHO,
    SVK,
    TURN,
    A,
    M,
    add_beam,
    affine,
    arc,
    ball,
    finalize,
    hexes,
    placed,
    plain,
    radial,
    rotation,
    scene,
    state_of,
    tets,
)

import warpfea as wf
from warpfea.model.surfaces import reference_points

# initial values


@pytest.mark.parametrize("name", BODIES)
def test_initial_velocity(name):
    """A spin about the centre of mass, and a velocity field, on all slots: e' = L e, so that F' F^-1 = L."""
    spin, L = np.array([3.0, -2.0, 5.0]), np.array([[0.1, 0.4, 0.2], [-0.3, 0.2, 0.5], [0.6, -0.1, 0.3]])
    b, body = scene(name)
    b.set_initial(body, velocity=(1, 2, 3), angular_velocity=spin)
    model = finalize(b)
    v = model.state().velocity.numpy()[0]
    W = np.cross(spin, np.eye(3)).T
    np.testing.assert_allclose(
        (v - v[0])[body.slot_kind == 0], (body.reference - body.reference[0])[body.slot_kind == 0] @ W.T, atol=1e-12
    )
    np.testing.assert_allclose(v[body.slot_kind > 0], body.reference[body.slot_kind > 0] @ W.T, atol=1e-12)
    momentum = model.mass_matrix() @ v.ravel()
    total = momentum.reshape(-1, 3)[body.slot_kind == 0].sum(axis=0)
    np.testing.assert_allclose(total, model.info()["mass"] * np.array([1, 2, 3]), rtol=1e-11)
    b, body = scene(name)
    b.set_initial(body, velocity=lambda X: X @ L.T)
    v = finalize(b).state().velocity.numpy()[0]
    np.testing.assert_allclose(v, (body.reference + (body.slot_kind == 0)[:, None] * body.origin) @ L.T, atol=1e-9)


@pytest.mark.parametrize("name", ["arc", "roof", "ENMC", "FN", "H3843"])
def test_a_spin_has_no_strain_rate(name):
    damped = replace(SVK, damping=wf.KelvinVoigt(eta=1e3, lambda_v=1e3, form="rate"))
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    source, _ = plain(name)
    make = {"ENMC": ("ENMC", tets("ENMC")), "FN": ("FN", tets("FN")), "H3843": ("H3843", hexes())}.get(name)
    if name == "arc":
        body = add_beam(arc, lambda s: TURN @ radial(s), material=damped, b=b)
    elif name == "roof":
        body = b.add_shell(source.mesh, thickness=0.1, material=damped)
    else:
        body = b.add_solid(make[1], material=damped, element=make[0])
    rates = []
    for how in ({"angular_velocity": (3, -2, 5)}, {"velocity": lambda X: X * [3.0, 0.0, 0.0]}):
        b.set_initial(body, **how)
        model = finalize(b)
        rates.append(model.evaluation.dissipation_rate(model.state())[0])
    assert abs(rates[0]) < 1e-20 * rates[1]


@pytest.mark.parametrize("name", ["beam", "plate", "ENMC", "FN", "H3843"])
def test_initial_place(name):
    """initial= as a function gives positions and gradients; nodal arrays can't say the gradients."""
    b, body = scene(name, initial=lambda X: X @ A.T + [1.0, 2.0, 3.0])
    u = finalize(b).state().displacement.numpy()[0]
    expected = affine(body, A) + (body.slot_kind == 0)[:, None] * (body.origin @ (A - np.eye(3)).T + [1.0, 2.0, 3.0])
    np.testing.assert_allclose(u, expected, atol=1e-9)
    X = body.mesh.points
    for call in (
        lambda: scene(name, initial=X),
        lambda: b.set_initial(body, velocity=X),
        lambda: b.set_initial(body, displacement=X),
    ):
        with pytest.raises(wf.ModelError, match=r"has gradients at its nodes; give a function X"):
            call()
    b.set_initial(body, displacement=(0, 0, 1))
    np.testing.assert_array_equal(
        finalize(b).state().displacement.numpy()[0], (body.slot_kind == 0)[:, None] * [0, 0, 1.0]
    )


# reports, drawing, fields


def test_info():
    b = wf.ModelBuilder()
    names = ["beam", "plate full", "ENMC", "H3843"]
    bodies = [BODIES[n](b, name=n) for n in names]
    b.add_moment(bodies[0].end, M)
    info = finalize(b).info()
    assert [d["element"] for d in info["bodies"]] == ["3243", "3443", "ENMC", "H3843"]
    assert [d["quadrature"] for d in info["bodies"]][:3] == [["tied"], ["full"], ["tet14"]]
    assert [d["elements"] for d in info["bodies"]] == [3, 4, 12, 12]
    assert [d["nodes"] for d in info["bodies"]][:2] == [4, 9]
    assert info["slots"] == 16 + 36 + bodies[2].slot_count + 4 * 36
    assert bodies[2].slot_count == 4 * 12 + len(bodies[2].mesh.points) - 12
    assert "moments" in info["features"]
    assert "follower pressure" in info["left_out"]
    assert {(k["element"], k["elements"]) for k in info["blocks"]} == {
        ("3243", 3),
        ("3443", 4),
        ("ENMC", 12),
        ("H3843", 12),
    }
    volume = 0.015 + 0.08 + 0.48 + bodies[3].mesh.volume()
    assert info["mass"] == pytest.approx(RHO * volume, rel=1e-12)


VOLUMES = {"beam": 0.015, "arc": 1.5 * 0.015, "plate": 0.08, "roof": 0.1, "ENMC": 0.48, "FN": 0.48}


@pytest.mark.parametrize("name", BODIES)
def test_skin_and_drawing(name):
    """The skin is closed, looks outward and encloses the volume; the drawn cells fill it."""
    body, _ = plain(name)
    volume = VOLUMES.get(name.split()[0]) or body.mesh.volume() if name != "ball" else ball().volume()
    skin = body.skin
    points = reference_points(body, skin.slot_weights)
    _, same = np.unique(np.round(points, 9), axis=0, return_inverse=True)
    T = same.ravel()[skin.triangles]
    edges = np.concatenate([T[:, [0, 1]], T[:, [1, 2]], T[:, [2, 0]]])
    forward = {tuple(e) for e in edges}
    assert len(forward) == len(edges)
    assert forward == {(b, a) for a, b in forward}
    x = points[skin.triangles] - points.mean(axis=0)
    enclosed = np.linalg.det(x).sum() / 6
    # the trilinear hexahedra have warped faces, the others are flat or drawn with chords
    tolerance = {"arc": 8e-3, "roof": 8e-3, "ball": 0.08, "H3843": 1e-3}.get(name, 1e-12)
    assert enclosed == pytest.approx(volume, rel=tolerance)
    if name in ("beam", "plate"):  # sharp edges: no point is shared between sides
        side = np.repeat(np.arange(len(skin.triangles)), 3)
        normal = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        first = np.full((len(points), 3), np.nan)
        first[skin.triangles.ravel()] = normal[side]
        assert np.abs(first[skin.triangles] - normal[:, None]).max() < 1e-9
    drawing = body.drawing
    cells = wf.mesh.Mesh(reference_points(body, drawing.slot_weights), drawing.cells, drawing.cell_type)
    assert cells.volumes().min() > 0
    assert cells.volume() == pytest.approx(volume, rel={"ball": 1e-12, "H3843": 1e-12}.get(name, tolerance))
    assert np.bincount(drawing.element).min() == len(body.family.vtk_subdivision.cells)
    for weights in (skin.node_weights, drawing.node_weights):  # fields of 1 stay 1
        np.testing.assert_allclose(weights @ np.ones(weights.shape[1]), 1.0, rtol=1e-12)


@pytest.mark.parametrize("name", BODIES)
def test_uniform_stress(name):
    """x = F X + c: von Mises stress of the full law at every node and on the skin, and F at the nodes.

    "tied" leaves out the transverse shear, which vanishes at a shell's faces and a beam's edges: there is none here. On
    curved axes the parts of the law have axes that turn, and add up but for the error of their interpolation.
    """
    body, model = plain(name)
    plane = np.array([[1.1, 0.2, 0], [0.2, 0.9, 0], [0, 0, 1.2]])
    stretch = {
        "plate": TURN @ plane @ TURN.T,
        "roof": np.diag([1.2, 0.9, 1.2]),
        "beam": TURN @ plane[::-1, ::-1] @ TURN.T,
        "arc": TURN @ np.diag([1.2, 1.2, 0.9]) @ TURN.T,
    }
    F = rotation(70.0) @ stretch.get(name, A)
    tolerance = 1e-10 if name not in ("arc", "roof") else 1e-3
    sim = wf.Simulation(model, state_of(model, affine(body, F, (1, 2, 3))), dt=1.0)
    strain = 0.5 * (F.T @ F - np.eye(3))
    lam, mu = SVK.lame
    cauchy = F @ (lam * np.trace(strain) * np.eye(3) + 2 * mu * strain) @ F.T / np.linalg.det(F)
    deviator = cauchy - np.trace(cauchy) / 3 * np.eye(3)
    expected = math.sqrt(1.5 * np.sum(deviator**2))
    field = sim.field("von_mises", body)
    assert field.shape == (1, len(body.mesh.points))
    np.testing.assert_allclose(field, expected, rtol=tolerance)
    np.testing.assert_allclose(sim.skin_field("von_mises", body), expected, rtol=tolerance)
    gradients = sim.node_gradients(body)[0]
    corner = body.node_slot_count == 4
    np.testing.assert_allclose(gradients[corner], np.broadcast_to(F, gradients[corner].shape), atol=1e-12)
    moved = sim.skin_points(body)[0]
    X = reference_points(body, body.skin.slot_weights) - body.origin
    np.testing.assert_allclose(moved, X @ F.T + body.origin + [1, 2, 3], atol=1e-12)


def test_node_gradients_need_gradients():
    b = wf.ModelBuilder()
    body = b.add_solid(tets("T10"), material=SVK)
    sim = wf.Simulation(finalize(b), dt=1.0)
    with pytest.raises(wf.ModelError, match="T10 has no nodal gradients"):
        sim.node_gradients(body)


def test_probes_and_point_loads_on_gradient_slots():
    """A probe of a material point and the work of a force there use the point's own functions."""
    b, body = scene("plate")
    X = placed(np.array([[0.37, 0.21, 0.04]]))[0]
    point = body.at(X)
    b.add_probe("p", point)
    b.add_probe("top", body.surface("top"))
    b.add_probe("edge", body.edge("x+"))
    b.add_point_load(point, (0, 0, 3.0))
    model = finalize(b)
    sim = wf.Simulation(model, dt=1e-3)
    sim.step(3)
    u = sim.state.displacement.numpy()[0]
    np.testing.assert_allclose(sim.probe("p").position[0, -1], X + point.weights @ u[point.slots], atol=1e-9)
    top = placed(np.array([[0.5, 0.4, 0.05]]))[0]
    record = sim.probe("top")
    np.testing.assert_allclose(record.position[0, -1] - record.displacement[0, -1], top, atol=1e-12)
    np.testing.assert_allclose(
        sim.probe("edge").displacement[0, -1],
        sim.displacements(body)[0, body.edge("x+").indices].mean(axis=0),
        atol=1e-15,
    )
    energies = sim.energies()
    work = sum(np.diff(np.concatenate([[[0, 0, 0]], sim.probe("p").displacement[0]]), axis=0) @ [0, 0, 3.0])
    assert energies["work_loads"][0] == pytest.approx(work, rel=1e-10)


def test_a_checkpoint_of_another_section_is_refused(tmp_path):
    def simulation(torsion):
        b = wf.ModelBuilder()
        section = wf.Rectangle(0.1, 0.1, torsion=torsion)
        beam = b.add_beam(
            [(0, 0, 0), (1, 0, 0)],
            elements=2,
            section=section,
            normal=(0, 0, 1),
            material=wf.SVK(E=1e7, nu=0.3, density=1000.0),
        )
        b.clamp(beam.start)
        return wf.Simulation(b.finalize(device="cpu"), dt=1e-3)

    simulation(None).run(2e-3, outputs=[wf.Checkpoint(tmp_path / "c.npz")], progress=False)
    simulation(None).resume(tmp_path / "c.npz")
    with pytest.raises(wf.CheckpointError):
        simulation(1e-5).resume(tmp_path / "c.npz")
