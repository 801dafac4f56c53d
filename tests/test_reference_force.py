"""Forces, energies, dissipation and eigenfrequencies of the S3 mesh against an independent implementation."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg

import warpfea as wf

RULES = {"q4": "tet4", "q5": "tet5_paper", "q14": "tet14"}
CASES = [(law, q) for law in ("svk", "mr") for q in RULES]


def displacement(p):
    """u of S3_force_vectors at the points p (n, 3)."""
    X, Y, Z = p.T
    return np.column_stack(
        [
            0.02 * np.sin(3 * X) + 0.1 * Y * Z - 0.3 * Z * X,
            0.05 * X * Y + 0.02 * X**2 - 0.03 * Z,
            -0.25 * X**2 + 0.04 * np.cos(5 * X) * Y + 0.05 * Z * X,
        ]
    )


def velocity(p):
    """v of S3_force_vectors."""
    X, Y, Z = p.T
    return np.column_stack([0.3 * X * Z - 0.1 * Y, 0.2 * np.sin(4 * X) + 0.1 * Z, -1.5 * X**2 + 0.4 * Y * X])


@pytest.fixture(scope="module")
def bar(data, device):
    ref = data.json("S3_force_vectors")
    damping = wf.KelvinVoigt(**ref["kelvin_voigt"])
    laws = {
        "svk": wf.SVK(**ref["svk"], density=ref["rho"], damping=damping),
        "mr": wf.MooneyRivlin(**ref["mooney_rivlin"], density=ref["rho"], damping=damping),
    }

    def make(law, q, **options):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        body = b.add_solid(data.mesh("S3_cantilever"), material=laws[law], quadrature=RULES[q])
        b.clamp(body.nodes(lambda X: np.abs(X[:, 0]) < 1e-9))
        return body, wf.Model(b.description, b.term_factory(), device=device, **options)

    return make


def moved(body, model):
    """A state with u and v of the reference, clamped nodes included."""
    state = model.state()
    X = body.mesh.points[body.slot_node]
    state.displacement.assign(displacement(X)[None])
    state.velocity.assign(velocity(X)[None])
    return state


@pytest.mark.parametrize(("law", "q", "tables"), [(*case, False) for case in CASES] + [("svk", "q4", True)])
def test_s3_force_vectors(bar, data, law, q, tables):
    body, model = bar(law, q, tables=tables)
    assert {block.key.affine for block in model.blocks} == {not tables}
    ref = data.json("S3_force_vectors")["results"][f"{law}_{q}"]
    state = moved(body, model)
    order = body.node_slot
    force = model.internal_force(state)[0, order]
    viscous = model.viscous_force(state)[0, order]
    assert data.error(force, ref["f_int"]) < 1e-12
    assert data.error(np.linalg.norm(force), ref["f_int_norm2"]) < 1e-12
    assert data.error(model.strain_energy(state)[0], ref["strain_energy"]) < 1e-12
    if ref["f_visc"] is not None:
        assert data.error(viscous, ref["f_visc"]) < 1e-12
    assert data.error(np.linalg.norm(viscous), ref["f_visc_norm2"]) < 1e-12
    assert data.error(model.evaluation.dissipation_rate(state)[0], ref["dissipation_rate"]) < 1e-12
    power = np.sum(viscous * velocity(body.mesh.points))
    assert data.error(power, ref["dissipation_rate"]) < 1e-12


def test_s3_mass(bar, data):
    _, model = bar("svk", "q4")
    ref = data.json("S3_force_vectors")["mass"]
    scalar = model.mass_matrix()[::3, ::3]
    assert data.error(scalar.sum(), ref["total"]) < 1e-13
    assert data.error(scalar.trace(), ref["trace_scalar"]) < 1e-13
    assert data.error(np.sqrt((scalar.data**2).sum()), ref["frobenius_scalar"]) < 1e-13


@pytest.mark.parametrize(("law", "q"), CASES)
def test_s3_eigenfrequencies(bar, data, law, q):
    _, model = bar(law, q)
    free = model.free_slots.ravel()
    K = model.tangent_matrix(model.state())[free][:, free].toarray()
    M = model.mass_matrix()[free][:, free].toarray()
    omega = np.sqrt(scipy.linalg.eigh(0.5 * (K + K.T), M, eigvals_only=True))
    ref = data.json("S3_eigenfrequencies")["results"][f"{law}_{q}"]
    assert data.error(omega[:12] / ref["first12"], np.ones(12)) < 1e-8
    assert data.error(omega[-1], ref["largest"]) < 1e-8
