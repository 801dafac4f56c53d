"""warpfea: flexible multibody dynamics with Total Lagrangian finite elements in NVIDIA Warp.

b = wf.ModelBuilder(); body = b.add_solid(...); model = b.finalize(); sim = wf.Simulation(model, dt=...); sim.run(...)
"""

import importlib as _importlib

from .base.checkout import bind_checkout_packages as _bind_checkout_packages

_bind_checkout_packages(__name__)

from . import mesh  # noqa: E402
from .base.errors import (  # noqa: E402
    CapacityError,
    CheckpointError,
    ConstraintError,
    ConvergenceError,
    Error,
    MeshError,
    MeshWarning,
    ModelError,
    ModelWarning,
    OutputError,
    PenetrationError,
    StabilityError,
    StabilityWarning,
)
from .base.version import __version__  # noqa: E402
from .builder.actuators import PD, Friction, Stop  # noqa: E402
from .builder.beams import spline  # noqa: E402
from .builder.builder import ModelBuilder  # noqa: E402
from .builder.joints import GROUND  # noqa: E402
from .builder.reference import Reference  # noqa: E402
from .builder.scene import scene  # noqa: E402
from .elements.sections import Circle, Rectangle, Section, Tube  # noqa: E402
from .materials import SVK, KelvinVoigt, MooneyRivlin, NeoHookean  # noqa: E402
from .model.bodies import Body  # noqa: E402
from .model.handles import ElementSet, MaterialPoint, NodeSet, SurfaceSet  # noqa: E402
from .model.joints import Joint  # noqa: E402
from .model.model import Model  # noqa: E402
from .model.shapes import Box, Capsule, Cylinder, HalfSpace, Sphere  # noqa: E402
from .model.state import State  # noqa: E402
from .model.triangle_mesh import TriMesh  # noqa: E402
from .outputs import by_suffix as _by_suffix  # noqa: E402, F401
from .outputs.html import HTMLWriter  # noqa: E402
from .outputs.render import GIFWriter, PNGWriter  # noqa: E402
from .outputs.usd import USDWriter  # noqa: E402
from .outputs.vtk import VTUWriter  # noqa: E402
from .outputs.vtk_reader import read_results  # noqa: E402
from .simulation import loss  # noqa: E402
from .simulation.adjoint import Adjoint  # noqa: E402
from .simulation.checkpoint import Checkpoint  # noqa: E402
from .simulation.integrators import EnergyMomentum, GeneralizedAlpha  # noqa: E402
from .simulation.modes import Buckling, Modes, buckling, modes  # noqa: E402
from .simulation.observations import Observations  # noqa: E402
from .simulation.simulation import Simulation, StepReport  # noqa: E402
from .simulation.statics import solve_static  # noqa: E402
from .solvers import Jacobi, NewtonPCG  # noqa: E402
from .time_laws import Control, Rotation  # noqa: E402

__all__ = [
    "GROUND", "PD", "SVK", "Adjoint", "Body", "Box", "Buckling", "CapacityError", "Capsule", "Checkpoint",
    "CheckpointError", "Circle", "ConstraintError", "Control", "ConvergenceError", "Cylinder", "Design", "ElementSet",
    "EnergyMomentum", "Error", "Friction", "GIFWriter", "GeneralizedAlpha", "HTMLWriter", "HalfSpace", "Jacobi",
    "Joint", "KelvinVoigt", "MaterialPoint", "MeshError", "MeshWarning", "Model", "ModelBuilder", "ModelError",
    "ModelWarning", "Modes", "MooneyRivlin", "NeoHookean", "NewtonPCG", "NodeSet", "Observations", "OutputError",
    "PNGWriter", "PenetrationError", "Rectangle", "Reference", "Rotation", "Section", "Simulation", "Sphere",
    "StabilityError", "StabilityWarning", "State", "StepReport", "Stop", "StudyOptions", "SurfaceSet", "TriMesh",
    "Tube", "USDWriter", "VTUWriter", "__version__", "buckling", "fit", "loss", "mesh", "modes", "read_results",
    "scene", "solve_static", "spline", "study", "sweep", "torch",
]  # fmt: skip


def __getattr__(name: str) -> object:
    """Lazy import of studies and sweeps: scenes import this package and must not depend on them.

    Declarations for type checkers: `__init__.pyi`.
    """
    if name in ("study", "StudyOptions"):
        return getattr(_importlib.import_module(f"{__name__}.studies.accuracy"), name)
    if name in ("sweep", "fit", "Design"):
        return getattr(_importlib.import_module(f"{__name__}.sweeps"), name)
    if name == "torch":
        return _importlib.import_module(f"{__name__}.simulation.torch")
    raise AttributeError(f"module 'warpfea' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
