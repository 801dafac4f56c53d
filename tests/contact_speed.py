"""Speed, memory and rest of contact between bodies on a GPU.

`python tests/contact_speed.py cuda:0 FILE [LABEL ...]` writes a row each:

search-N: two layers of T4, of which a tenth overlaps, with N facets between them: seconds from the mesh to the first
step, compilation apart; ms of a search with features and of all forces (graphs, median of 5 times 20); bytes a point.
worlds-NAME: 4096 worlds of two blocks of 2^3 cells that fall on each other, and of a finger pressed on a block; with
the stiffness of the region and full restitution, or by default.
thirty: scene `pile` to its end: largest component of a slot's velocity then, kinetic energy over that of the fall.
"""

import functools
import json
import pathlib
import statistics
import sys
import time

import numpy as np
import warp as wp
from validation.piles import pile

import warpfea as wf
from scenes.pile import pile as thirty
from warpfea.base.provenance import provenance_of
from warpfea.contact.facets import FacetContact
from warpfea.simulation.checkpoint import save_checkpoint

RUBBER = wf.NeoHookean.from_E_nu(E=1e6, nu=0.4, density=1000.0)
HELD = {"restitution": 1.0, "stiffness": ("region", 1.0)}
WORLDS, WORLD_STEPS = 4096, 20
FACETS = (1_000, 10_000, 100_000, 1_000_000)


def layers(facets):
    cells = round((facets / 4) ** 0.5)
    size = 0.01 * cells
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    low = [(0.9 * i * size + 0.003 * i, 0.0, 0.01 * i) for i in range(2)]
    meshes = [wf.mesh.box((size, size, 0.01), cells=(cells, cells, 1), element="T4", origin=at) for at in low]
    lower, upper = (b.add_solid(mesh, material=RUBBER, name=f"layer {i}") for i, mesh in enumerate(meshes))
    b.clamp(lower.nodes("z-"))
    b.add_contact(upper.surface("z-"), lower.surface("z+"), mu=0.5, overlap="offset")
    return b, upper


def median_ms(device, do):
    """Of a launch in a graph."""
    with wp.ScopedCapture(device) as captured:
        do()
    rounds = []
    for _ in range(5):
        wp.synchronize_device(device)
        began = time.perf_counter()
        for _ in range(20):
            wp.capture_launch(captured.graph)
        wp.synchronize_device(device)
        rounds.append((time.perf_counter() - began) / 20)
    return 1e3 * statistics.median(rounds)


def search(facets, device):
    began = time.perf_counter()
    b, upper = layers(facets)
    model = b.finalize(device=device)
    sim = wf.Simulation(model, dt=1e-3, solver=wf.NewtonPCG(preconditioner="block-jacobi"), ledger=False)
    ctx, term = sim.stepper.ctx, model.terms.find(FacetContact)
    wp.synchronize_device(device)
    setup = time.perf_counter() - began
    on = wp.ones(1, dtype=wp.int32, device=device)
    ctx.work.step.h.fill_(1e-3)
    u = 1e-5 * np.random.default_rng(1).standard_normal((1, model.slots, 3))
    u[:, upper.slots] -= (0, 0, 1e-4)
    term.begin(ctx, on)
    ctx.work.u.assign(u)
    term.force(ctx, on)
    touching = int((ctx.scratch[term.name]["attempt"].activity.numpy() > 0).sum())
    find = functools.partial(term._search_facets, ctx, ctx.work.u, on, overlap_limit=0.0)
    own = sum(count for name, count in sim.bytes().items() if "contact" in name or "pairs" in name)
    return {
        "facets": sum(len(m.conn) for m in term.tables.masters) * 2, "points": term.tables.points, "touching": touching,
        "setup_s": setup, "search_ms": median_ms(device, find),
        "force_ms": median_ms(device, lambda: term.force(ctx, on)), "bytes_per_point": own / term.tables.points,
    }  # fmt: skip


def blocks(options):
    return pile(2, not options, cubes=2, stiffness=1.0), 1e-2


def finger(options):
    b = wf.ModelBuilder()
    arm = b.add_solid(wf.mesh.box((0.12, 0.02, 0.02), cells=(4, 1, 1), origin=(-0.12, -0.01, 0.04)), material=RUBBER)
    b.clamp(arm.nodes("x-"))
    b.add_traction(arm.surface("z+"), (0.0, 0.0, -2e3))
    cube = b.add_solid(wf.mesh.box((0.04,) * 3, cells=(1, 1, 1), origin=(-0.04, -0.02, 0.0)), material=RUBBER)
    b.add_contact(cube.surface("z-"), b.add_collider(wf.HalfSpace((0, 0, 1), 0.0)), mu=0.5, **options)
    b.add_contact(arm.surface("z-"), cube.surface("z+"), mu=0.5, **options)
    return b, 2e-3


def throughput(scene, options, device):
    b, dt = scene(options)
    sim = wf.Simulation(b.finalize(device=device, worlds=WORLDS), dt=dt, ledger=False)
    sim.step()
    sim.reset()
    before = {name: int(sim.totals[name][0]) for name in ("newton", "pcg")}
    began = time.perf_counter()
    sim.step(WORLD_STEPS)
    wp.synchronize_device(device)
    seconds = time.perf_counter() - began
    spent = {name: (int(sim.totals[name][0]) - count) / WORLD_STEPS for name, count in before.items()}
    return {"worlds": WORLDS, "world_steps_per_s": WORLDS * WORLD_STEPS / seconds, **spent}


def rest(device):
    model = thirty().finalize(device=device)
    sim = wf.Simulation(model, dt=thirty.dt, solver=wf.NewtonPCG(tol=thirty.tol))
    began, deepest, steps = time.perf_counter(), 0.0, round(thirty.t_end / thirty.dt)
    for _ in range(steps):
        deepest = max(deepest, float(sim.step().penetration.max()))
    fall = -float(sim.energies()["potential"][0])
    save_checkpoint(sim, pathlib.Path(sys.argv[2]).with_name("pile.npz"))
    return {
        "bodies": len(model.bodies), "steps": steps, "seconds": time.perf_counter() - began,
        "newton": int(sim.totals["newton"][0]), "pcg": int(sim.totals["pcg"][0]), "fall_J": fall,
        "kinetic_over_fall": float(sim.energies()["kinetic"][0]) / fall,
        "fastest": float(np.abs(sim.state.velocity.numpy()).max()), "deepest": deepest,
        "deepest_at_rest": float(sim.last.penetration.max()),
    }  # fmt: skip


ROWS = {f"search-{n:.0e}".replace("+0", ""): functools.partial(search, n) for n in FACETS}
for scene in (blocks, finger):
    ROWS[f"worlds-{scene.__name__}"] = functools.partial(throughput, scene, HELD)
    ROWS[f"worlds-{scene.__name__}-default"] = functools.partial(throughput, scene, {})
ROWS["thirty"] = rest

if __name__ == "__main__":
    device, file, *labels = sys.argv[1:]
    content = provenance_of([], device) | {"command": f"python tests/contact_speed.py {device} FILE", "rows": []}
    search(1_000, device)  # compiles
    for label in labels or ROWS:
        content["rows"].append({"label": label} | ROWS[label](device))
        print(json.dumps(content["rows"][-1]), flush=True)
        pathlib.Path(file).write_text(json.dumps(content, indent=2) + "\n")
