"""Iterations and work per step of scenes on the CPU, rows of ablation.py: `python tests/scene_counts.py --out FILE`.

The scenes of `warpfea bench --worlds` with one world, and those of the package that take less than 15 s. Counted over
`STEPS` steps after `BEFORE` others: iterations of Newton's method and of PCG, matrices assembled, factorisations,
launches, and the bytes of the arrays that launches reach, which are most of the time of large models.
"""

from __future__ import annotations

import argparse
import pathlib
from collections.abc import Callable
from typing import Any

import warpfea as wf
from warpfea.base.console import quiet_warp, to_json, write_json
from warpfea.builder.scene import find
from warpfea.studies.bench.worlds import SCENES as WORLDS
from warpfea.studies.profile.profiling import replay

__all__ = ["COUNTS"]

BEFORE, STEPS = 10, 60
COUNTS = {
    "newton": "Newton iterations", "pcg": "PCG iterations", "matrices": "matrices", "factorisations": "factorisations",
    "launches": "launches", "bytes": "bytes",
}  # fmt: skip
"""Keys of counts -> words."""
SCENES = (
    "arch", "ball_on_plate", "beam_over_cylinders", "belt", "block_stack", "chain", "four_bar", "hung_plate",
    "plate_pendulum", "rollup", "spin", "tilting_table", "twist",
)  # fmt: skip


def row_of(label: str, build: Callable[[], wf.ModelBuilder], dt: float, **options: Any) -> dict[str, Any]:
    """Row of a scene."""
    row = {"case": label, "precision": "float64", "passed": False, "outcome": "refused", "note": ""}
    try:
        sim = wf.Simulation(build().finalize(device="cpu"), dt=dt, ledger=False, record=False, **options)
        sim.step(BEFORE)
        done = replay(sim, STEPS)
    except wf.Error as error:
        return row | {"note": f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"}
    kernels = done.recorder.kernels(1, 0.0)

    def launches(part: str, word: str) -> int:
        return int(sum(kernel.launches for kernel in kernels if part in kernel.part and word in kernel.kernel))

    return row | {
        "passed": True, "outcome": "done", "newton": round(done.newton * STEPS), "pcg": round(done.pcg * STEPS),
        "matrices": launches("assembly", "element_matrix"), "factorisations": launches("build", "factor_"),
        "launches": launches("", ""), "bytes": int(sum(kernel.bytes for kernel in kernels)),
    }  # fmt: skip


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=pathlib.Path, required=True)
    parser.add_argument("--case", nargs="+", default=[""], help="names, or parts of them; by default all")
    options = parser.parse_args()
    tasks: list[tuple[str, Callable[[], wf.ModelBuilder], float, dict[str, Any]]] = []
    tasks += [(f"worlds/{name}", build, dt, {}) for name, (build, dt) in WORLDS.items()]
    for scene in map(find, SCENES):
        settings = {"integrator": scene.integrator, "solver": wf.NewtonPCG(tol=scene.tol)}
        tasks.append((f"scenes/{scene.name}", scene, scene.dt, settings))
    with quiet_warp():
        chosen = [task for task in tasks if any(word in task[0] for word in options.case)]
        rows = [row_of(label, build, dt, **settings) for label, build, dt, settings in chosen]
    write_json(str(options.out), to_json({"rows": rows}))


if __name__ == "__main__":
    main()
