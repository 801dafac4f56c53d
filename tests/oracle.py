"""Comparison of two commits, bit by bit: `python tests/oracle.py --baseline COMMIT [--rows LABEL ...] [--out FILE]`.

Each row is run with the baseline, in a worktree of its own, and with the tree that this file lies in, on the same
machine: digests of u and v, Newton and PCG iterations, launches recorded for a step, bytes, ledgers, and the difference
of u over its largest value. Rows: every scene, and a table of precisions x integrators x contact x worlds x joints x
statics in which every pair of values occurs. Exit code 0 where all rows agree, 1 where one does not.
`RENAMES` maps what has another name since.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import json
import os
import pathlib
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from typing import Any

ROOT = pathlib.Path(__file__).resolve().parents[1]
RENAMES: dict[str, str] = {}
"""Old name -> new name: of ledger columns, and of the dotted paths that `COUNTS` reads."""
COUNTS = {"launches": "stepper.launch.launches"}
INTEGRATORS = ("backward_euler", "bdf2", "energy_momentum", "generalized_alpha")
CONTACTS = ("none", "default", "paper", "pairs")


def table() -> dict[str, dict[str, Any]]:
    """The pairwise rows by label: an orthogonal array of strength two, and a row of the smooth law."""
    out = {}
    for i, c in itertools.product(range(4), range(4)):
        row = {
            "integrator": INTEGRATORS[i],
            "contact": CONTACTS[c],
            "dtype": ("float64", "float32")[(i ^ c) & 1],
            "worlds": (1, 3)[((i ^ c) >> 1) & 1],
            "joint": bool((i ^ (c >> 1)) & 1),
            "static": bool(((i >> 1) ^ c) & 1),
        }
        out[f"{row['integrator']}-{row['contact']}"] = row
    smooth = {"contact": "smooth", "dtype": "float64", "worlds": 3, "joint": True, "static": False}
    return out | {"backward_euler-smooth": {"integrator": "backward_euler", **smooth}}


# the child: one row with the warpfea on PYTHONPATH


def build(row: dict[str, Any]) -> Any:
    """A clamped bar, a block that rests on it or a floor, and a flap on a hinge, as the row asks."""
    import warpfea as wf

    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    damping = wf.KelvinVoigt(eta=30.0)
    law = wf.SVK(E=2e6, nu=0.3, density=1000.0, damping=damping)
    bar = b.add_solid(wf.mesh.box((0.4, 0.1, 0.1), cells=(4, 1, 1)), material=law, name="bar")
    b.clamp(bar.nodes("x-"))
    if row["contact"] != "none":
        where = (0.25, 0.01, 0.1)
        mesh = wf.mesh.box((0.08, 0.08, 0.08), cells=(2, 2, 1), origin=where, element="T4")
        block = b.add_solid(mesh, material=wf.NeoHookean.from_E_nu(E=1e6, nu=0.3, density=800.0), name="block")
        if row["static"]:
            b.clamp(block.nodes("z+"), components="xy")
        else:
            b.set_initial(block, velocity=(0.2, 0.0, -0.5))
        if row["contact"] == "pairs":
            b.add_contact(block, bar, mu=0.3, restitution=1.0, stiffness=("region", 10.0))
        else:
            floor = b.add_collider(wf.HalfSpace(normal=(0, 0, 1), offset=0.1))
            law_name = {"default": "default", "paper": "paper", "smooth": "smooth"}[row["contact"]]
            b.add_contact(block.surface("z-"), floor, mu=0.3, law=law_name, restitution=0.5)
    if row["joint"]:
        line, strip = [(0.4, 0.05, 0.05), (0.7, 0.05, 0.05)], wf.Rectangle(0.03, 0.03)
        flap = b.add_beam(line, elements=3, section=strip, normal=(0, 0, 1), material=law, name="flap")
        kind = "fixed" if row["static"] else "revolute"
        axis = {} if row["static"] else {"axis": (0, 1, 0)}
        b.add_joint(kind, parent=bar.surface("x+"), child=flap.start, name="hinge", **axis)
    return b


def measure(label: str, options: argparse.Namespace, renames: dict[str, str]) -> dict[str, Any]:
    """One row, with u in the file `options.save`: a refusal is a result as well."""
    import numpy as np

    import warpfea as wf
    from warpfea.builder.scene import find

    def count(sim: Any, path: str) -> Any:
        for name in (renames.get(path, path), path):
            value = sim
            for part in name.split("."):
                value = getattr(value, part, None)
            if value is not None:
                return value
        return None

    def digest(array: Any) -> str:
        return hashlib.sha256(np.ascontiguousarray(array.numpy()).tobytes()).hexdigest()[:16]

    row, device = table().get(label), options.device
    out: dict[str, Any] = {}
    try:
        if row and row["static"]:
            model = build(row).finalize(device=device, dtype=row["dtype"], worlds=row["worlds"])
            result = wf.solve_static(model, load_steps=2, stabilise=row["contact"] != "none")
            state, report = result.state, result.report
            out |= {"newton": report.newton.tolist(), "pcg": report.pcg.tolist()}
        else:
            if row:
                model = build(row).finalize(device=device, dtype=row["dtype"], worlds=row["worlds"])
                sim = wf.Simulation(model, dt=2e-3, integrator=row["integrator"])
            else:
                scene = find(label)
                model = scene().finalize(device=device)
                how = wf.NewtonPCG(tol=options.tol or scene.tol)
                sim = wf.Simulation(model, dt=scene.dt, integrator=scene.integrator, solver=how)
            out |= {name: count(sim, path) for name, path in COUNTS.items()}
            out["bytes"] = int(sum(sim.bytes().values()))
            sim.step(options.steps)
            state = sim.state
            out |= {name: sim.totals[name].tolist() for name in ("newton", "pcg")}
            energies = sim.energies()
            out["ledger"] = {renames.get(k, k): [float(x).hex() for x in v] for k, v in sorted(energies.items())}
        out |= {"u": digest(state.displacement), "v": digest(state.velocity)}
        np.save(options.save, state.displacement.numpy().astype(float))
    except wf.Error as error:
        out["refused"] = type(error).__name__
    return out


# the parent


def run(tree: pathlib.Path, label: str, options: argparse.Namespace, save: str) -> dict[str, Any]:
    """The row in a process of its own with the package of a tree."""
    env = os.environ | {"PYTHONPATH": str(tree), "PYTHONSAFEPATH": "1"}
    command = [sys.executable, __file__, "--measure", label, "--device", options.device, "--save", save]
    command += ["--steps", str(options.steps), *(["--tol", str(options.tol)] if options.tol else [])]
    done = subprocess.run(command, cwd=tree, env=env, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{label} in {tree}: {done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def compare(trees: list[pathlib.Path], label: str, options: argparse.Namespace) -> dict[str, Any]:
    """The row in both trees: their results, and the largest difference of u over its largest value."""
    import numpy as np

    with tempfile.TemporaryDirectory() as folder:
        files = [str(pathlib.Path(folder) / f"{k}.npy") for k in range(2)]
        old, new = (run(tree, label, options, file) for tree, file in zip(trees, files))
        out: dict[str, Any] = {"baseline": old, "present": new, "equal": not differences(old, new)}
        if all(map(os.path.exists, files)):
            u = [np.load(file) for file in files]
            out["u difference"] = float(np.abs(u[1] - u[0]).max() / (np.abs(u[0]).max() or 1.0))
        return out


def differences(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Differences of two results, in words."""
    return [f"{key}: {old.get(key)} -> {new.get(key)}" for key in sorted({*old, *new}) if old.get(key) != new.get(key)]


def main() -> int:
    """Run the command line; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--baseline", help="the commit to compare with")
    parser.add_argument("--rows", nargs="+", help="labels; by default all")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--steps", type=int, default=6)
    parser.add_argument("--tol", type=float, help="of Newton's method in scenes; by default the scene's")
    parser.add_argument("--out", type=pathlib.Path, help="JSON of all rows, of both commits")
    parser.add_argument("--list", action="store_true", help="print the labels")
    parser.add_argument("--measure", help=argparse.SUPPRESS)
    parser.add_argument("--save", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure:
        print(json.dumps(measure(options.measure, options, RENAMES)))
        return 0
    scenes = [p.stem for p in sorted((ROOT / "scenes").glob("[a-z]*.py"))]
    rows = options.rows or [*scenes, *table()]
    if options.list or not options.baseline:
        print("\n".join(rows))
        return 0 if options.list else 2
    results, failed = {}, 0
    with tempfile.TemporaryDirectory() as folder:
        tree = pathlib.Path(folder) / "baseline"
        git = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*git, "add", "--detach", "--quiet", str(tree), options.baseline], check=True)
        try:
            with ThreadPoolExecutor(2) as pool:
                for label, row in zip(rows, pool.map(lambda label: compare([tree, ROOT], label, options), rows)):
                    found = differences(row["baseline"], row["present"])
                    failed += bool(found)
                    results[label] = row
                    print(f"{label:36} {'equal' if not found else '; '.join(found)}", flush=True)
        finally:
            subprocess.run([*git, "remove", "--force", str(tree)], check=True)
    if options.out:
        from warpfea.base.provenance import provenance_of

        about = provenance_of([], options.device) | {"command": " ".join(["python", *sys.argv])}
        about |= {"baseline": options.baseline, "settings": {"steps": options.steps, "tol": options.tol}}
        for row in results.values():
            row["baseline"].pop("ledger", None), row["present"].pop("ledger", None)
        options.out.write_text(json.dumps(about | {"rows": results}, indent=1) + "\n")
    print(f"{len(rows) - failed} of {len(rows)} rows equal")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
