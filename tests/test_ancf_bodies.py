"""ANCF bodies in a scene: surfaces, supports, moments."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
import warp as wp
from ancf_bodies import (
    BODIES,
    E_MODULUS,
    SHIFT,
    SVK,
    TURN,
    A,
    M,
    add_beam,
    affine,
    finalize,
    placed,
    plain,
    rotation,
    scene,
    state_of,
    tets,
    turned,
)

import warpfea as wf
from warpfea.model import assembly
from warpfea.terms.follower_loads import FollowerLoads

FLAT = [name for name in BODIES if name not in ("arc", "roof", "ball")]
SIDES = ("beam", "arc", "plate", "roof", "ENMC", "ball", "H3843")


# surfaces


NAMED = {
    "beam": {"start": 0.015, "end": 0.015, "side-": 0.1, "side+": 0.1, "normal-": 0.15, "normal+": 0.15},
    "arc": {"start": 0.015, "end": 0.015, "normal-": 1.5 * 0.95 * 0.15, "normal+": 1.5 * 1.05 * 0.15, "side+": 0.15},
    "plate": {"top": 0.8, "bottom": 0.8, "x-": 0.08, "x+": 0.08, "y-": 0.1, "y+": 0.1},
    "roof": {"top": 1.05, "bottom": 0.95, "x-": 0.1, "x+": 0.1, "y-": 0.1, "y+": 0.1},
    "ENMC": {"x-": 0.48, "y+": 0.6, "z-": 0.8},
}


@pytest.mark.parametrize("name", NAMED)
def test_named_surfaces(name):
    """Traction on each: force per reference area, at its centroid; outward normals from the pressure's resultant."""
    force = np.array([3.0, -2.0, 8.0])
    for side, area in NAMED[name].items():
        b, body = scene(name)
        surface = body.surface(side)
        b.add_traction(surface, force)
        b.add_pressure(surface, 5.0)
        load = b.description.dead_loads[0]
        total = load.weights[body.slot_kind[load.slots] == 0].sum()
        assert total == pytest.approx(area, rel=1e-12 if name in FLAT else 6e-3), side
        center = load.weights @ body.reference[load.slots] / total + body.origin
        model = finalize(b)
        pushed = follower_force(model, model.state())
        if name in FLAT:
            outward = center - placed(np.array([0.5, 0.0 if name == "beam" else 0.4, 0.3 * (name == "ENMC")])[None])[0]
            pushed = pushed[body.slot_kind == 0].sum(axis=0)
            assert np.linalg.norm(pushed) == pytest.approx(5.0 * area, rel=1e-10)
            assert pushed @ outward < -0.99 * 5.0 * area * np.linalg.norm(outward)
    with pytest.raises((wf.ModelError, wf.MeshError), match="named 'left'"):
        body.surface("left")


def test_surfaces_by_predicate_and_rows():
    for name in ("beam", "plate"):
        body, _ = plain(name)
        every = body.surface(lambda X: np.ones(len(X), bool))
        assert len(every) == {"beam": 2 + 4 * 3, "plate": 2 * 4 + 8}[name]
        half = body.surface(lambda X: (X - SHIFT) @ TURN[:, 0] > 0.999)
        np.testing.assert_array_equal(half.faces, body.surface("end" if name == "beam" else "x+").faces)
        np.testing.assert_array_equal(body.surface(half.faces).faces, half.faces)
        for bad in ([[99, 0]], [[0, 6]], [0, 1], [[0.0, 1.0]]):
            with pytest.raises(wf.ModelError, match="surface"):
                body.surface(np.array(bad))


def follower_force(model, state):
    """Force of pressures and moments at a state, (slots, 3), by the kernels of a step."""
    return _launched(model, state, "force")


def follower_product(model, state, direction):
    """The kernels' tangent of them times a direction."""
    return _launched(model, state, "product", direction)


def _launched(model, state, what, *fields):
    terms, vec3 = model.terms, model.types.vec3
    values = np.array([law.values[-1] for law in terms.time_laws.laws])[None]
    values = wp.array(values, dtype=wp.vec3d, device="cpu")
    active = wp.ones(1, dtype=wp.int32, device="cpu")
    out = wp.zeros((1, terms.nonpotential_entries), dtype=vec3, device="cpu")
    extra = [wp.array(f[None], dtype=vec3, device="cpu") for f in fields]
    for part in terms.find(FollowerLoads).loads:
        share = [1.0, (1.0, 1.0)] if what == "product" else []
        args = [part.data, *share, state.displacement, values, active, *extra, out]
        wp.launch(getattr(part, what), dim=(1, part.count), inputs=args, device="cpu")
    force = np.zeros((model.slots, 3))
    start, entry = (
        terms.nonpotential_topology.contribution_start.numpy(),
        terms.nonpotential_topology.contribution_entry.numpy(),
    )
    np.add.at(force, np.repeat(np.arange(model.slots), np.diff(start)), out.numpy()[0][entry])
    return force


def moment_of(body, u, f):
    """Resultant moment about the body's origin: sum of e_i x f_i over all slots."""
    return np.cross(body.reference + u, f).sum(axis=0)


def bent(body, seed=0):
    """Displacements of a large strain and rotation."""
    noise = np.random.default_rng(seed).uniform(-1, 1, body.reference.shape)
    return affine(body, rotation(70.0) @ A, (1.0, 2.0, 3.0)) + np.where(body.slot_kind == 0, 0.01, 0.1)[:, None] * noise


@pytest.mark.parametrize("name", SIDES)
def test_pressure_on_a_closed_surface(name):
    """No resultant, no moment, the volume as its potential, and the exact tangent: it is symmetric."""
    b, body = scene(name)
    b.add_pressure(body.surface(lambda X: np.ones(len(X), bool)), 1e3)
    model = finalize(b)
    u = bent(body)
    f = follower_force(model, state_of(model, u))
    scale = np.abs(f).sum()
    assert np.abs(f[body.slot_kind == 0].sum(axis=0)).max() < 1e-13 * scale
    assert np.abs(moment_of(body, u, f)).max() < 1e-13 * scale * 4
    # a uniform growth about the origin: - p 3 V, with V in the deformed place by the mass rule
    rule = body.family.curved_mass_rule
    _, ds, _, _ = assembly.shape_and_jacobian(body, np.arange(len(body.mesh.cells)), rule.points)
    det = np.linalg.det(np.einsum("esk,eqsl->eqkl", (body.reference + u)[body.connectivity], ds))
    assert np.sum(f * (body.reference + u)) == pytest.approx(-3e3 * np.sum(det * rule.weights), rel=1e-10)
    d = np.random.default_rng(5).uniform(-1, 1, u.shape)
    numeric = difference(lambda t: follower_force(model, state_of(model, u + t * d)), 1e-2)
    assert np.abs(follower_product(model, state_of(model, u), d) - numeric).max() < 1e-10 * np.abs(numeric).max()


def difference(f, h):
    """Derivative at 0 by central differences with an error of O(h^6)."""
    one, two, three = ((f(k * h) - f(-k * h)) / (60 * h) for k in (1, 2, 3))
    return 45 * one - 9 * two + three


# supports


@pytest.mark.parametrize(
    ("name", "slots", "kinds"),
    [
        ("beam", "position", (0,)),
        ("beam", "position+axis", (0, 1)),
        ("beam", "position+section", (0, 2, 3)),
        ("beam", "all", (0, 1, 2, 3)),
        ("plate", "position+surface", (0, 1, 2)),
        ("plate", "director", (3,)),
        ("H3843", "gradients", (1, 2, 3)),
        ("ENMC", "all", (0, 1, 2, 3)),
        ("ENMC", "position", (0,)),
    ],
)
def test_clamped_slots(name, slots, kinds):
    b, body = scene(name)
    nodes = body.start if name == "beam" else body.nodes("x-")
    b.clamp(nodes, slots=slots, components="xz")
    held = ~finalize(b).free_slots
    expected = np.isin(body.slot_kind, kinds) & np.isin(body.slot_node, nodes.indices)
    np.testing.assert_array_equal(held, expected[:, None] & np.array([True, False, True]))
    assert expected.sum() == len(kinds) * len(nodes) or name == "ENMC"  # its face nodes have a position only


@pytest.mark.parametrize(
    ("name", "known"),
    [
        ("beam", "3243: 'position', 'axis', 'section', 'all'"),
        ("plate", "3443: 'position', 'surface', 'director', 'all'"),
        ("FN", "FN: 'position', 'gradients', .*'all'"),
    ],
)
def test_unknown_slots(name, known):
    b, body = scene(name)
    for call in (b.clamp, functools.partial(b.drive, displacement=(0, 0, 1))):
        with pytest.raises(wf.ModelError, match=f"'position.twist': valid slots of element {known}, or several"):
            call(body.nodes([0]), slots="position+twist")


@pytest.mark.parametrize("name", ["beam", "plate", "ENMC", "H3843"])
def test_driven_gradients(name):
    """A driven end turns with all its slots; a displacement holds the gradients."""
    axis, anchor = np.array([1.0, 2.0, -1.0]), np.array([0.1, 0.2, 0.3])
    for kind in ("rotation", "displacement"):
        b, body = scene(name)
        nodes = body.start if name == "beam" else body.nodes("x-")
        law = {"displacement": ([0, 1], [(0, 0, 0), (0.3, 0, 0)])}
        if kind == "rotation":
            law = {"rotation": wf.Rotation(anchor, axis, ([0, 1], [0, math.radians(30)]))}
        b.drive(nodes, **law, slots="all")
        model = finalize(b)
        assert model.free_slots[np.isin(body.slot_node, nodes.indices)].sum() == 0
        sim = wf.Simulation(model, dt=0.25)
        sim.step(2)
        R = rotation(15.0, axis) if kind == "rotation" else np.eye(3)
        X = body.mesh.points[nodes.indices]
        x = (X - anchor) @ R.T + anchor if kind == "rotation" else X + [0.15, 0, 0]
        np.testing.assert_allclose(sim.positions(body)[0, nodes.indices], x, atol=1e-13)
        F = sim.node_gradients(body)[0, nodes.indices]
        with_gradients = body.node_slot_count[nodes.indices] == 4
        np.testing.assert_allclose(F[with_gradients], np.broadcast_to(R, F[with_gradients].shape), atol=1e-13)
        assert np.isnan(F[~with_gradients]).all()
        assert (~with_gradients).any() == (name == "ENMC")


# moments


PLACES = ["beam end", "arc end", "beam point", "plate edge", "roof edge", "roof point"]
PLACES += ["ENMC node", "ENMC point", "FN node", "H3843 node", "H3843 point", "T10 point"]


@pytest.mark.parametrize("name", PLACES)
def test_moment(name):
    """Its nodal forces have the moment m and no resultant, their work in a rigid rotation is m.omega, and the kernels'
    tangent is the symmetric part of the exact one."""
    b, body, where = turned(name)
    b.add_moment(where, M)
    model = finalize(b)
    u = bent(body)
    f = follower_force(model, state_of(model, u))
    expected = M
    if name.split()[0] in ("plate", "roof"):  # the part along the director does nothing
        if name.endswith("point"):
            d = ((body.reference + u)[where.slots].T @ (where.gradients @ where.axes))[:, 2][None]
        else:
            d = (body.reference + u)[body.node_slot[where.indices] + 3]
        d = d / np.linalg.norm(d, axis=1, keepdims=True)
        expected = np.mean(M - (d @ M)[:, None] * d, axis=0)
    np.testing.assert_allclose(moment_of(body, u, f), expected, atol=1e-12 * np.abs(f).max())
    assert np.abs(f[body.slot_kind == 0].sum(axis=0)).max() < 1e-13 * max(np.abs(f).max(), 1)
    omega = np.array([0.3, 0.7, -1.1])
    velocity = np.cross(omega, body.reference + u) + (body.slot_kind == 0)[:, None] * [5.0, -1.0, 2.0]
    assert np.sum(f * velocity) == pytest.approx(expected @ omega, rel=1e-11)

    used = np.flatnonzero(np.abs(f).max(axis=1) > 0)
    unit = np.zeros((3 * len(used), model.slots, 3))
    unit[np.arange(3 * len(used)), np.repeat(used, 3), np.tile(np.arange(3), len(used))] = 1.0
    state = state_of(model, u)
    force = lambda d, t: follower_force(model, state_of(model, u + t * d))  # noqa: E731
    exact = np.array([difference(functools.partial(force, d), 5e-4)[used].ravel() for d in unit])
    kernel = np.array([follower_product(model, state, d)[used].ravel() for d in unit])
    assert np.abs(kernel - 0.5 * (exact + exact.T)).max() < 1e-8 * np.abs(exact).max()


def test_moment_bends_a_beam_into_an_arc():
    """A free section: M at the tip of a clamped beam gives the slope M L / EI exactly."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = add_beam([(0, 0, 0), (1, 0, 0)], elements=8, b=b)
    EI = E_MODULUS * 0.15 * 0.1**3 / 12
    b.clamp(body.start, slots="position+section")
    b.add_moment(body.end, (0, -EI * 0.5, 0))
    static = wf.solve_static(finalize(b), load_steps=2)
    assert static.displacements(body)[0, -1, 2] == pytest.approx((1 - math.cos(0.5)) / 0.5, rel=5e-3)


def test_moments_need_gradients():
    b = wf.ModelBuilder()
    t10 = b.add_solid(tets("T10"), material=SVK)
    enmc = b.add_solid(tets("ENMC"), material=SVK, element="ENMC", name="enmc")
    for body, node in ((t10, 0), (enmc, enmc.mesh.cells[0, 5])):
        with pytest.raises(wf.ModelError, match=r"have no gradients to turn; use a point body\.at"):
            b.add_moment(body.nodes([node]), M)
