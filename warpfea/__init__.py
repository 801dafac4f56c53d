"""warpfea: flexible multibody dynamics with Total Lagrangian finite elements in NVIDIA Warp."""

from __future__ import annotations

import importlib.util
import pathlib
import sys

__version__ = "0.1.0.dev0"


def _map_checkout() -> None:
    """In a source checkout `kernels/` and `scenes/` lie beside this package: bind just these two names."""
    root = pathlib.Path(__file__).resolve().parent.parent
    if not (root / "pyproject.toml").is_file():
        return
    for name in ("kernels", "scenes"):
        init = root / name / "__init__.py"
        full = f"{__name__}.{name}"
        if full in sys.modules or not init.is_file():
            continue
        spec = importlib.util.spec_from_file_location(full, init, submodule_search_locations=[str(init.parent)])
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[full] = module
        spec.loader.exec_module(module)
        globals()[name] = module


_map_checkout()

from . import mesh  # noqa: E402
from .bodies import Body, ElementSet, MaterialPoint, NodeSet, SurfaceSet  # noqa: E402
from .builder import ModelBuilder, Rotation  # noqa: E402
from .errors import *  # noqa: E402, F403
from .materials import SVK, KelvinVoigt, MooneyRivlin, NeoHookean  # noqa: E402
from .model import Model  # noqa: E402
from .simulation import Simulation, StepReport  # noqa: E402
from .solvers import NewtonPCG  # noqa: E402
from .state import State  # noqa: E402
from .statics import solve_static  # noqa: E402
