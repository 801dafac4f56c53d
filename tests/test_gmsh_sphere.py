"""A second-order sphere as Gmsh meshes it, through the table path: volume, mass, rigid motion, patch."""

import pathlib

import numpy as np
import pytest

import warpfea as wf

FILE = pathlib.Path(__file__).resolve().parent / "data" / "sphere_gmsh.msh"
A = np.array([[0.05, 0.02, 0.0], [0.01, -0.03, 0.04], [0.0, 0.02, 0.02]])


def ball(law, prepare=None):
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_solid(FILE, material=law, name="ball")
    if prepare:
        prepare(b, body)
    return body, b.finalize(device="cpu")


LAWS = [wf.SVK(E=1e6, nu=0.3, density=7.0), wf.NeoHookean(mu=4e5, k=1e6, density=7.0)]


def test_volume_and_mass():
    body, model = ball(LAWS[0])
    assert model.features["table elements"]
    volume = body.mesh.volume()
    assert volume == pytest.approx(4 / 3 * np.pi, rel=2e-3)
    assert model.info()["mass"] == pytest.approx(7.0 * volume, rel=1e-13)
    assert len(body.surface("surface")) == len(body.mesh.boundary())


@pytest.mark.parametrize("law", LAWS, ids=["svk", "neo-hookean"])
def test_rigid_motion_costs_nothing(law):
    body, model = ball(law)
    c, s = np.cos(2.0), np.sin(2.0)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    state = model.state()
    state.displacement.assign((body.reference @ (R - np.eye(3)).T + (3.0, -1.0, 2.0))[None])
    size = np.abs(model.tangent_matrix(model.state())).max()
    assert np.abs(model.internal_force(state)).max() < 1e-12 * size


@pytest.mark.parametrize("law", LAWS, ids=["svk", "neo-hookean"])
def test_patch(law):
    def outside(b, body):
        u = body.mesh.points[body.nodes("surface").indices] @ A.T
        b.drive(body.nodes("surface"), displacement=([0, 1], np.stack([0 * u, u])))

    body, model = ball(law, outside)
    u = wf.solve_static(model, load_steps=1, tol=1e-12).displacements(body)[0]
    exact = body.mesh.points @ A.T
    assert np.abs(u - exact)[body.mesh.used_nodes].max() < 1e-12 * np.abs(exact).max()
