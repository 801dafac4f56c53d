"""Device code of the scenes compiles for CUDA, without a device."""

import json
import pathlib
import subprocess
import sys
import time

import pytest

HERE = pathlib.Path(__file__).parent
MOST = 1000.0
"""s: three times what 134 modules take beside other tests on two slow cores; unrolled loops take far longer."""


@pytest.mark.slow
def test_modules_of_the_scenes_compile_for_cuda():
    """The modules recorded by `cuda_modules.py --record`, in a process of its own."""
    began = time.perf_counter()
    done = subprocess.run([sys.executable, str(HERE / "cuda_modules.py")], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert int(done.stdout.splitlines()[-1].split()[0]) > 40
    assert time.perf_counter() - began < MOST, done.stdout


def test_recorded_factories_exist():
    recorded = json.loads((HERE / "data" / "cuda_modules.json").read_text())
    for module, factory, *_ in recorded["calls"]:
        path = HERE.parent / (module.removeprefix("warpfea.").replace(".", "/") + ".py")
        assert f"def {factory}(" in path.read_text(), (module, factory)
