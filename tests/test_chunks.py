"""Matrices are assembled for some worlds at a time: no bit of a result depends on how many."""

import numpy as np
import pytest

import warpfea as wf
from scenes import double_pendulum, pendulum
from warpfea.solvers import matrix_assembly

WORLDS = 5


def beam(**_):
    b = pendulum.pendulum(elements=4)
    m = b.finalize(device="cpu", worlds=WORLDS)
    m.set_parameter("beam.E", 7e5 * (1.0 + np.arange(WORLDS)))
    m.set_parameter("beam.density", 1e3 * (1.0 + np.arange(WORLDS)))
    return m


def joints(**_):
    return double_pendulum.double_pendulum().finalize(device="cpu", worlds=WORLDS)


def stack(**_):
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    law = wf.NeoHookean.from_E_nu(E=1e6, nu=0.4, density=1000.0)
    low = b.add_solid(wf.mesh.box((0.1, 0.1, 0.05), cells=(2, 2, 1)), material=law, name="low")
    top = wf.mesh.box((0.06, 0.06, 0.05), cells=(1, 1, 1), origin=(0.02, 0.02, 0.05))
    b.add_contact(low, b.add_solid(top, material=law, name="top"), mu=0.4, name="between")
    b.clamp(low.nodes("z-"))
    m = b.finalize(device="cpu", worlds=WORLDS)
    m.set_parameter("top.E", 1e6 * (1.0 + np.arange(WORLDS)))
    return m


@pytest.mark.parametrize("preconditioner", ["two-level", "banded"])
@pytest.mark.parametrize("build", [beam, joints, stack])
def test_chunks_change_no_bit(build, preconditioner, monkeypatch):
    def run(enlarged=False):
        m = build()
        m.set_gravity([(0.3 * world, 0.0, -9.81) for world in range(WORLDS)])
        solver = wf.NewtonPCG(preconditioner=preconditioner)
        sim = wf.Simulation(m, dt=2e-3, solver=solver, record=False, capture=not enlarged)
        if enlarged:
            sim.stepper.newton.residual.assembler.enlarge_chunks(WORLDS * sim.bytes()["work.element matrices"] // 2)
        sim.step(4)
        return sim.state.numpy(), sim.bytes()

    whole, bytes_whole = run()
    monkeypatch.setattr(matrix_assembly, "MIN_CHUNK_WORLDS", 2)
    monkeypatch.setattr(matrix_assembly, "MAX_CHUNKS", 3)
    name = "work.element matrices"
    for enlarged in (False, True):
        state, bytes_now = run(enlarged)
        for key, values in whole.items():
            assert np.array_equal(state[key], values, equal_nan=True), key
        assert 5 * bytes_now[name] == (5 if enlarged else 2) * bytes_whole[name]
