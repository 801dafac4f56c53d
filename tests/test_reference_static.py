"""Statics against independent software on the same meshes: S1 cantilever (SVK), S2 cube (Mooney-Rivlin)."""

from __future__ import annotations

import numpy as np
import pytest

import warpfea as wf

RULES = {"q4": "tet4", "q5": "tet5_paper", "q14": "tet14"}
KS = ("1e+08", "1e+06")
LATERAL = {"y": 1, "z": 2}


def plane(axis, value):
    return lambda X: np.abs(X[:, axis] - value) < 1e-9


# S1: cantilever under a dead traction


@pytest.fixture(scope="module")
def cantilever(data, device):
    ref = data.json("S1_static_svk_cantilever")

    def solve(size, q):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        law = wf.SVK(E=ref["E"], nu=ref["nu"])
        body = b.add_solid(data.mesh(f"S1_cantilever_{size}"), material=law, quadrature=RULES[q])
        b.clamp(body.nodes(plane(0, 0.0)))
        tip = body.surface(plane(0, 1.0))
        b.add_traction(tip, ref["traction"])
        b.add_probe("tip", tip)
        model = b.finalize(device=device)
        result = wf.solve_static(model, load_steps=1, tol=1e-10)
        return body, model, result, ref["meshes"][size]["results"][f"felupe_{q}"]

    return solve


@pytest.mark.parametrize(
    ("size", "q"), [("coarse", "q4"), ("coarse", "q5"), ("coarse", "q14"), ("medium", "q4"), ("medium", "q5")]
)
def test_s1_cantilever(cantilever, data, size, q):
    body, model, result, ref = cantilever(size, q)
    travel = np.linalg.norm(ref["tip_face_mean_displacement"])
    tip = result.probe("tip").displacement[0, -1]
    assert data.error(tip, ref["tip_face_mean_displacement"], travel) < 1e-8
    corner = ref["corner_node_at_1_0_0"]
    assert data.error(result.displacements(body)[0, corner["index0"]], corner["u"], travel) < 1e-8
    assert data.error(model.strain_energy(result.state)[0], ref["strain_energy"]) < 1e-8
    assert data.error(result.reaction(body.nodes(plane(0, 0.0)))[0], [0, 0, 10.5]) < 1e-8


# S2: cube


@pytest.fixture(scope="module")
def cube(data, device):
    """Builder and body of the S2 cube; `solve` gives the static result with the model."""
    ref = data.json("S2_static_mooney_rivlin_cube")

    def make(k, q):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        law = wf.MooneyRivlin(mu10=ref["mu10"], mu01=ref["mu01"], k=float(k))
        return b, b.add_solid(data.mesh("S2_cube"), material=law, quadrature=RULES[q])

    def solve(b):
        model = b.finalize(device=device)
        return model, wf.solve_static(model, load_steps=2, tol=1e-10)

    return make, solve


def stretch(b, body, amount):
    """x = 0, y = 0, z = 0 slide in their planes; x = 1 is moved along x."""
    for axis, name in enumerate("xyz"):
        b.clamp(body.nodes(plane(axis, 0.0)), components=name)
    end = body.nodes(plane(0, 1.0))
    b.drive(end, displacement=(amount, 0, 0), components="x")
    return end


@pytest.mark.slow
@pytest.mark.parametrize("q", ["q4", "q5"])
@pytest.mark.parametrize("k", KS)
def test_s2_uniaxial(cube, data, k, q):
    make, solve = cube
    b, body = make(k, q)
    end = stretch(b, body, 1.0)
    model, result = solve(b)
    ref = data.json("S2_static_mooney_rivlin_cube")["cases"][f"uniaxial_k{k}_{q}"]
    assert data.error(result.reaction(end)[0, 0], ref["reaction_x"]) < 1e-8
    assert data.error(model.strain_energy(result.state)[0], ref["strain_energy"]) < 1e-8


@pytest.mark.parametrize("case", [0, 2, 4, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 3, 5))])
def test_s2_uniaxial_closed_form(cube, data, case):
    ref = data.json("S2_closed_form_homogeneous")["uniaxial"][case]
    make, solve = cube
    b, body = make(ref["k"], "q4")
    end = stretch(b, body, ref["stretch"] - 1.0)
    model, result = solve(b)
    X = body.mesh.points
    lateral = ref["lateral_stretch"]
    exact = X * (np.array([ref["stretch"], lateral, lateral]) - 1.0)
    assert data.error(result.displacements(body)[0], exact) < 1e-8
    assert data.error(result.reaction(end)[0, 0], ref["P11_nominal_stress"]) < 1e-8
    assert data.error(model.strain_energy(result.state)[0], ref["strain_energy_density"]) < 1e-8
    assert data.error(model.evaluation.minimum_jacobian(result.state)[0], ref["J"]) < 1e-8


@pytest.mark.parametrize("q", ["q4", "q5"])
@pytest.mark.parametrize("k", KS)
def test_s2_affine_shear(cube, data, k, q):
    make, solve = cube
    b, body = make(k, q)
    X = body.mesh.points
    outer = body.nodes(np.unique(body.mesh.faces(body.mesh.boundary())))
    assert len(outer) < len(X), "the patch test needs inner nodes"
    sheared = np.zeros((len(X), 3))
    sheared[:, 0] = X[:, 1]
    b.drive(outer, displacement=([0, 1], np.stack([0 * sheared, sheared])[:, outer.indices]))
    model, result = solve(b)
    u = result.displacements(body)[0]
    ref = data.json("S2_static_mooney_rivlin_cube")["cases"][f"simple_shear_affine_k{k}_{q}"]
    closed = data.json("S2_closed_form_homogeneous")["simple_shear"]
    assert data.error(u, sheared) < 1e-8
    assert data.error(u[ref["probe_node"]["index0"]], ref["probe_node"]["u"]) < 1e-8
    top = result.reaction(body.nodes(plane(1, 1.0)))[0]
    assert data.error(top, ref["top_reaction"]) < 1e-8
    assert data.error(top[:2], np.array(closed["P"])[:2, 1]) < 1e-8
    energy = model.strain_energy(result.state)[0]
    assert data.error(energy, ref["strain_energy"]) < 1e-8
    assert data.error(energy, closed["Psi"]) < 1e-8
    for _, stress in model.evaluation.stresses(result.state):
        order = np.array(closed["cauchy"])[[0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1]]
        assert data.error(stress, np.broadcast_to(order[None, None, None], stress.shape)) < 1e-8


@pytest.mark.parametrize("q", ["q4", "q5"])
@pytest.mark.parametrize("k", KS)
def test_s2_sheared_block_with_free_sides(cube, data, k, q):
    make, solve = cube
    b, body = make(k, q)
    b.clamp(body.nodes(plane(1, 0.0)))
    top = body.nodes(plane(1, 1.0))
    b.drive(top, displacement=(1, 0, 0))
    model, result = solve(b)
    ref = data.json("S2_static_mooney_rivlin_cube")["cases"][f"shear_block_free_sides_k{k}_{q}"]
    probe = ref["probe_node"]
    assert data.error(result.displacements(body)[0, probe["index0"]], probe["u"]) < 1e-8
    assert data.error(result.reaction(top)[0], ref["top_reaction"]) < 1e-8
    assert data.error(model.strain_energy(result.state)[0], ref["strain_energy"]) < 1e-8
