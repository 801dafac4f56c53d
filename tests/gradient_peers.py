"""Gradients beside other software: `python tests/gradient_peers.py FILE`, in an environment with torch, torch-fem (its
pyvista, for pictures, is not needed) and newton; on one core, where times are those of the process.

"cube": a cube of linear tetrahedra (SVK), clamped below, sheared and pressed above; d(mean height)/dE.
"soft body": Newton's example diffsim_soft_body, a block thrown at a wall and the floor: derivatives of its loss by mu
and lambda, and of the same block, in implicit steps and with contact of its own, by E, each beside its own central
differences, the best of six lengths.
"""

import json
import pathlib
import sys
import time
import types
from importlib import metadata
from unittest.mock import MagicMock

import numpy as np

import warpfea as wf
from warpfea.base.provenance import provenance_of

CELLS, E, NU, FORCE = 6, 1e6, 0.3, np.array([200.0, 0.0, -400.0])  # Pa, N
LENGTHS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
TARGET = np.array([0.0, -1.0, 1.5])


def timed(call):
    began = time.process_time()
    return call(), time.process_time() - began


def cube_here(mesh):
    """Mean height of the top, its derivative, seconds of the solve and of the derivative; weights of its nodes."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_solid(mesh, material=wf.SVK(E=E, nu=NU, density=1000.0), name="cube")
    b.clamp(body.nodes("z-"))
    b.add_traction(body.surface("z+"), FORCE / 0.01)
    b.add_probe("top", body.surface("z+"))
    model = b.finalize(device="cpu")
    model.set_parameter("cube.E", E)

    def solve(modulus):
        model.set_parameter("cube.E", modulus)
        return wf.solve_static(model, load_steps=4, tol=1e-10)

    def gradient(result):
        tape = wf.Adjoint(result, "cube.E")
        height = tape.probe("top").displacement
        height.grad.assign(np.array([[[0, 0, 1.0]]]))
        return height.numpy()[0, 0, 2], tape.backward()["cube.E"].numpy()[0]

    gradient(solve(E))  # compiles
    result, forward = timed(lambda: solve(E))
    (height, slope), back = timed(lambda: gradient(result))
    probe = model.description.probes[0]
    weights = np.zeros(len(mesh.points))
    node_of = {int(slot): node for node, slot in enumerate(body.slots)}
    np.add.at(weights, [node_of[int(probe.body.slot_offset + slot)] for slot in probe.slots], probe.weights)

    def value(modulus):
        return solve(modulus).probe("top").displacement[0, -1, 2]

    return (height, slope, forward, back, value), weights


def cube_torch_fem(mesh, weights):
    import torch

    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float64)
    for name in ("pyvista", "pyvista.plotting"):
        sys.modules.setdefault(name, MagicMock())
    from torchfem import Solid
    from torchfem.materials import Hyperelastic3D

    def psi(F, params):
        strain = 0.5 * (F.transpose(-1, -2) @ F - torch.eye(3))
        return 0.5 * params[0] * torch.trace(strain) ** 2 + params[1] * torch.trace(strain @ strain)

    def run(modulus):
        lame = torch.stack([modulus * NU / ((1 + NU) * (1 - 2 * NU)), 0.5 * modulus / (1 + NU)])
        cube = Solid(torch.tensor(mesh.points), torch.tensor(mesh.cells.astype(np.int64)), Hyperelastic3D(psi, lame))
        cube.constraints[mesh.points[:, 2] < 1e-9] = True
        cube.forces[:] = torch.tensor(weights[:, None] * FORCE)
        more = {"differentiable_parameters": modulus} if modulus.requires_grad else {}
        u = cube.solve(torch.linspace(0, 1, 5), rtol=1e-10, atol=1e-12, max_iter=20, **more)[0]
        return torch.tensor(weights) @ u[:, 2]

    run(torch.tensor(E))
    modulus = torch.tensor(E, requires_grad=True)
    height, forward = timed(lambda: run(modulus))
    _, back = timed(height.backward)
    return float(height.detach()), float(modulus.grad), forward, back, lambda x: float(run(torch.tensor(x)))


def differences(value, at, exact):
    """Least relative error of central differences."""
    found = [(value(at * (1 + h)) - value(at * (1 - h))) / (2 * h * at) for h in LENGTHS]
    return float(np.min(np.abs(np.array(found) / exact - 1.0)))


def cubes():
    mesh = wf.mesh.box((0.1,) * 3, cells=(CELLS,) * 3, element="T4")
    ours, weights = cube_here(mesh)
    rows = []
    for name, found in (("warpfea", ours), ("torch-fem", cube_torch_fem(mesh, weights))):
        height, slope, forward, back, value = found
        rows.append({
            "label": "cube", "of": name, "unknowns": 3 * len(mesh.points), "value": height, "derivative": slope,
            "error": differences(value, E, slope), "forward_s": forward, "backward_s": back,
        })  # fmt: skip
    return rows


def newton_soft_body():
    import warp as wp
    from newton.examples.diffsim.example_diffsim_soft_body import Example

    class Uncaptured(Example):
        def capture(self):
            self.graph = None

    with wp.ScopedDevice("cpu"):
        example = Uncaptured(MagicMock(), types.SimpleNamespace(verbose=False, material_behavior="isotropic"))
        start = example.material_params.numpy().astype(float)

        def loss(params, run):
            example.material_params.assign(np.asarray(params, dtype=np.float32))
            for array in (example.loss, example.com, example.pos_error):
                array.zero_()
            run()
            return float(example.loss.numpy()[0])

        loss(start, example.forward_backward)  # compiles
        example.tape.zero()
        _, forward = timed(lambda: loss(start, example.forward))
        value, both = timed(lambda: loss(start, example.forward_backward))
        slopes = example.material_params.grad.numpy().astype(float)
        example.tape.zero()
        units = np.eye(2)

        def along(k):
            return lambda x: loss(start + (x - start[k]) * units[k], example.forward)

        errors = [differences(along(k), start[k], slopes[k]) for k in range(2)]
    return {
        "label": "soft body", "of": "newton", "unknowns": 81, "steps": 960, "dt": example.sim_dt, "value": value,
        "derivative": slopes.tolist(), "error": errors, "forward_s": forward, "backward_s": both - forward,
    }  # fmt: skip


def soft_body():
    """The same block in 240 implicit steps."""
    mesh = wf.mesh.box((0.2,) * 3, cells=(2,) * 3, origin=(-0.1, -0.5, 1.0), element="T4")
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    law = wf.NeoHookean.from_E_nu(E=1.5e4, nu=0.3, density=0.2 / 0.008)
    block = b.add_solid(mesh, material=law, name="block")
    b.set_initial(block, velocity=(0, 6.0, -6.0))
    wall = b.add_collider(wf.Box((0, 2.0, 1.0), (2.0, 0.5, 2.0)), name="wall")
    floor = b.add_collider(wf.HalfSpace(normal=(0, 0, 1)), name="floor")
    for name, other in (("w", wall), ("f", floor)):
        b.add_contact(block, other, mu=0.2, restitution=0.5, seam=0, name=name)
    b.add_probe("middle", block.at((0.0, -0.4, 1.1)))
    model = b.finalize(device="cpu")
    model.set_parameter("block.E", 1.5e4)
    sim = wf.Simulation(model, dt=1.0 / 240.0, solver=wf.NewtonPCG(tol=1e-10), record=False, ledger=False)
    tape = wf.Adjoint(sim, "block.E")
    end = np.full((240, 3), np.nan)
    end[-1] = TARGET

    def run(modulus):
        model.set_parameter("block.E", modulus)
        sim.reset()
        tape.clear()
        tape.run(240)
        return wf.loss.sum_of_squares(tape.probe("middle").position, end)

    tape.backward(run(1.5e4))  # compiles
    loss, forward = timed(lambda: run(1.5e4))
    g, back = timed(lambda: tape.backward(loss))
    slope = float(g["block.E"].numpy()[0])
    return {
        "label": "soft body", "of": "warpfea", "unknowns": 81, "steps": 240, "dt": sim.dt,
        "value": float(loss.numpy()[0]), "derivative": slope, "switches": int(g.switches[0]),
        "error": differences(lambda x: float(run(x).numpy()[0]), 1.5e4, slope), "forward_s": forward,
        "backward_s": back,
    }  # fmt: skip


def main(file):
    rows = [*cubes(), soft_body(), newton_soft_body()]
    content = provenance_of([], "cpu") | {"command": "python tests/gradient_peers.py FILE", "rows": rows}
    content["versions"] |= {name: metadata.version(name) for name in ("torch", "torch-fem", "newton")}
    pathlib.Path(file).write_text(json.dumps(content, indent=2) + "\n")
    print(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main(*sys.argv[1:])
