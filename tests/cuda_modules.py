"""Device code of all scenes: the calls that make it, recorded on one machine and compiled for CUDA on another.

On a machine with a CUDA device, `python tests/cuda_modules.py --record` writes `tests/data/cuda_modules.json`:
the calls of the factories of `kernels/` while a simulation of each scene is made. `python tests/cuda_modules.py`
makes the same kernels and compiles them for sm_90, which needs no driver; `test_cuda_modules.py` does so too.
"""

from __future__ import annotations

import argparse
import functools
import importlib
import json
import pathlib
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor

import warp as wp

FILE = pathlib.Path(__file__).parent / "data" / "cuda_modules.json"
ARCH = 90
HOST = "_rows"
"""Modules that only the CPU launches: a thread does a whole element, which takes a minute to compile for CUDA."""


class Recorder:
    """Outermost calls of factories: those that another factory makes come again with it."""

    def __init__(self):
        self.calls, self.skipped, self.depth = set(), set(), 0

    def cache(self, factory):
        """In place of functools.cache, for modules that are imported from now on."""
        cached = functools._lru_cache_wrapper(factory, None, False, functools._CacheInfo)
        if not factory.__module__.startswith("warpfea.kernels"):
            return cached

        @functools.wraps(factory)
        def made(*args, **kwargs):
            if self.depth == 0:
                self.note(factory, args, kwargs)
            self.depth += 1
            try:
                return cached(*args, **kwargs)
            finally:
                self.depth -= 1

        return made

    def note(self, factory, args, kwargs):
        """Keep a call, unless an argument is a function of a user."""
        try:
            call = [factory.__module__, factory.__name__, [encoded(a) for a in args],
                    {k: encoded(v) for k, v in kwargs.items()}]  # fmt: skip
            self.calls.add(json.dumps(call))
        except TypeError:
            self.skipped.add(f"{factory.__module__}.{factory.__name__}")


def encoded(value):
    """An argument as JSON; TypeError of one that has no such form."""
    if hasattr(value, "_asdict"):
        return {"traits": value._asdict()}
    if hasattr(value, "coefficients"):
        return {"integrator": value.name}
    if isinstance(value, tuple):
        return [encoded(x) for x in value]
    if isinstance(value, wp.Module):
        return {"module": value.name, "options": {k: value.options[k] for k in ("max_unroll",)}}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(value)


def decoded(value):
    """The argument that was encoded."""
    from warpfea.kernels.common.modules import kernel_module
    from warpfea.kernels.common.traits import Traits

    from warpfea.simulation.integrators import INTEGRATORS

    if isinstance(value, list):
        return tuple(map(decoded, value))
    if not isinstance(value, dict):
        return value
    if "traits" in value:
        return Traits(**value["traits"])
    if "integrator" in value:
        return INTEGRATORS[value["integrator"]]
    return kernel_module(value["module"].removeprefix("warpfea.kernels."), **value["options"])


def record(device: str) -> None:
    """Write the calls of all scenes."""
    recorder = Recorder()
    functools.cache = recorder.cache
    import warpfea as wf
    from warpfea.builder.scene import find, names

    for name in names():
        scene = find(name)
        model = scene().finalize(device=device)
        wf.Simulation(model, dt=scene.dt, integrator=scene.integrator, solver=wf.NewtonPCG(tol=scene.tol))
        print(name, len(recorder.calls), flush=True)
    rows = [json.loads(call) for call in sorted(recorder.calls)]
    lines = ",\n".join(f"  {json.dumps(row)}" for row in rows)
    where = wp.get_device(device).name
    FILE.write_text(f'{{\n"device": {json.dumps(where)},\n"skipped": {json.dumps(sorted(recorder.skipped))},\n'
                    f'"calls": [\n{lines}\n]\n}}\n')  # fmt: skip


def compile_all(folder: str) -> list[str]:
    """Compile the recorded modules for CUDA and print how long each took; their names."""
    wp.is_cuda_available = lambda: True  # options of modules are those of a machine with a device
    for module, factory, args, kwargs in json.loads(FILE.read_text())["calls"]:
        make = getattr(importlib.import_module(module), factory)
        make(*map(decoded, args), **{k: decoded(v) for k, v in kwargs.items()})
    every = wp._src.context.user_modules.values()
    modules = [m for m in every if m.name.startswith("warpfea.kernels.") and m.kernels and not m.name.endswith(HOST)]

    def compiled(module):
        began = time.perf_counter()
        wp.compile_aot_module(module, arch=ARCH, module_dir=f"{folder}/{module.name}")
        took = time.perf_counter() - began
        print(f"{took:6.2f} s  {module.name}", flush=True)
        return module.name

    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(compiled, modules))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--record", action="store_true", help="write the calls, in place of compiling")
    parser.add_argument("--device", default="cuda", help="to record on")
    options = parser.parse_args()
    if options.record:
        return record(options.device)
    with tempfile.TemporaryDirectory() as folder:
        rows = compile_all(folder)
    print(f"{len(rows)} modules compiled for sm_{ARCH}")


if __name__ == "__main__":
    main()
