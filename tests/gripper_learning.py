"""Learn a gripper's controls by torch: `python tests/gripper_learning.py DEVICE WORLDS FILE`."""

import json
import pathlib
import sys
import time

import numpy as np

import warpfea as wf
from warpfea.base.provenance import provenance_of

STEPS, ITERATIONS, TARGET = 40, 4, 0.08  # m


def gripper(device, worlds):
    """Two jaws whose paths are controls, and a soft block of another density in each world."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    law = wf.NeoHookean.from_E_nu(E=5e4, nu=0.3, density=300.0, damping=wf.KelvinVoigt(50.0))
    mesh = wf.mesh.box((0.06,) * 3, cells=(2, 2, 2), origin=(-0.03, -0.03, 0), element="T4")
    block = b.add_solid(mesh, material=law, name="block")
    floor = b.add_collider(wf.HalfSpace(normal=(0, 0, 1)), name="floor")
    b.add_contact(block.surface("z-"), floor, mu=0.3, restitution=0.2, name="base")
    for name, sign in (("left", -1.0), ("right", 1.0)):
        box = wf.Box((sign * 0.041, 0, 0.035), (0.02, 0.05, 0.05))
        jaw = b.add_collider(box, path=wf.Control(name, 3), name=name)
        b.add_contact(block.surface(f"x{'-' if sign < 0 else '+'}"), jaw, mu=0.6, restitution=0.2, name=f"{name} grip")
    b.add_probe("middle", block.at((0, 0, 0.03)))
    model = b.finalize(device=device, worlds=worlds)
    model.set_parameter("block.density", np.linspace(250.0, 350.0, worlds))
    return wf.Simulation(model, dt=5e-3, solver=wf.NewtonPCG(tol=1e-8), record=False, ledger=False)


def learn(device, worlds):
    """Losses of the iterations, m^2, and the heights at the last (worlds,), m."""
    import torch

    sim = gripper(device, worlds)
    kind = {"dtype": torch.float64, "device": torch.device("cuda" if "cuda" in device else "cpu")}
    knots = np.linspace(0, STEPS - 1, 5)
    hats = torch.tensor(np.array([np.interp(np.arange(STEPS), knots, row) for row in np.eye(5)[1:]]).T, **kind)
    close = torch.full((4,), 0.0025, requires_grad=True, **kind)
    lift = torch.zeros(4, requires_grad=True, **kind)
    optimizer = torch.optim.Adam([{"params": [close], "lr": 2e-4}, {"params": [lift], "lr": 1e-2}])
    losses = []
    for _ in range(ITERATIONS):
        x, z = hats @ close, hats @ lift
        jaws = {"left": torch.stack([x, 0 * x, z], dim=1), "right": torch.stack([-x, 0 * x, z], dim=1)}
        height = wf.torch.rollout(sim, jaws)["middle"].position[:, -1, 2]
        loss = ((height - TARGET) ** 2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    return losses, height.detach().cpu().numpy()


def main(device, worlds, file):
    began = time.perf_counter()
    losses, height = learn(device, int(worlds))
    row = {"worlds": int(worlds), "losses": losses, "lowest": height.min(), "highest": height.max()}
    row["seconds"] = time.perf_counter() - began
    content = provenance_of([], device) | {"command": f"python tests/gripper_learning.py {device} {worlds} FILE"}
    pathlib.Path(file).write_text(json.dumps(content | {"rows": [row]}, indent=2) + "\n")
    print(row)


if __name__ == "__main__":
    main(*sys.argv[1:])
