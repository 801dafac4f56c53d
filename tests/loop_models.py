"""Small models in worlds for loops of learning, and the values of one world's state."""

import numpy as np
import pytest
import warp as wp

import warpfea as wf

QUIET = {"record": False, "on_failure": "freeze", "ledger": False}
DT = 2e-3
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]


def cubes(worlds=1, dtype="float64", device="cpu"):
    """A cube that falls on a floor, with a probe."""
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    law = wf.NeoHookean.from_E_nu(E=1e5, nu=0.3, density=1000.0, damping=wf.KelvinVoigt(10.0))
    body = b.add_solid(wf.mesh.box((0.1,) * 3, cells=(1, 1, 1), origin=(0, 0, 1e-3)), material=law, name="cube")
    b.add_contact(body, b.add_collider(wf.HalfSpace((0, 0, 1))), mu=0.3, restitution=0.3, name="pad")
    b.add_probe("top", body.surface("z+"))
    return b.finalize(device=device, worlds=worlds, dtype=dtype)


def arms(worlds=1, dtype="float64", device="cpu"):
    """A bar on a driven hinge that pulls a second one by a distance."""
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    law = wf.SVK(E=1e9, nu=0.3, density=1000.0)
    section, up = wf.Rectangle(0.02, 0.02), (0, 0, 1)
    one, two = (
        b.add_beam([(x, 0, 0), (x + 0.3, 0, 0)], elements=2, section=section, normal=up, material=law, name=name)
        for x, name in ((0, "one"), (0.4, "two"))
    )
    b.add_joint("revolute", parent=wf.GROUND, child=one.start, axis=(0, 1, 0), drive=wf.Control("motor"), name="motor")
    b.add_joint("distance", parent=one.end, child=two.start, name="rope")
    return b.finalize(device=device, worlds=worlds, dtype=dtype)


def stacks(worlds=1, dtype="float64", device="cpu"):
    """A cube that falls on a slab."""
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    law = wf.NeoHookean.from_E_nu(E=1e5, nu=0.3, density=1000.0)
    slab = b.add_solid(wf.mesh.box((0.2, 0.2, 0.05), cells=(2, 2, 1)), material=law, name="slab")
    cube = b.add_solid(wf.mesh.box((0.1,) * 3, cells=(1, 1, 1), origin=(0.05, 0.05, 0.051)), material=law, name="cube")
    b.clamp(slab.nodes("z-"))
    b.add_contact(cube, slab, mu=0.3, name="pad")
    return b.finalize(device=device, worlds=worlds, dtype=dtype)


def bent(worlds=1, dtype="float64", device="cpu"):
    """A bar that begins bent."""
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    law = wf.NeoHookean.from_E_nu(E=1e6, nu=0.4, density=1000.0)
    body = b.add_solid(wf.mesh.box((1, 0.1, 0.1), cells=(4, 1, 1)), material=law, name="bar")
    b.clamp(body.nodes("x-"))
    b.set_initial(body, displacement=lambda X: np.outer(X[:, 0] ** 2, (0.0, 0.0, 0.1)))
    return b.finalize(device=device, worlds=worlds, dtype=dtype)


def values(sim, world=0):
    """All that a world's state has."""
    return {name: array[world] for name, array in sim.state.numpy().items()}


def same(one, other):
    return all(np.array_equal(one[name], other[name], equal_nan=True) for name in one)


def flags(*worlds, of=4, dtype=wp.int32, device="cpu"):
    mask = np.zeros(of, dtype=bool)
    mask[list(worlds)] = True
    return wp.array(mask.astype(bool if dtype is wp.bool else np.int32), dtype=dtype, device=device)
