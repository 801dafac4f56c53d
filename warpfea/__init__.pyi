"""Interface for type checkers: the names of `__init__.py`, those imported on use included."""
# ruff: noqa: I001

from . import mesh as mesh
from .base.errors import (
    CapacityError as CapacityError,
    CheckpointError as CheckpointError,
    ConstraintError as ConstraintError,
    ConvergenceError as ConvergenceError,
    Error as Error,
    MeshError as MeshError,
    MeshWarning as MeshWarning,
    ModelError as ModelError,
    ModelWarning as ModelWarning,
    OutputError as OutputError,
    PenetrationError as PenetrationError,
    StabilityError as StabilityError,
    StabilityWarning as StabilityWarning,
)
from .base.version import __version__ as __version__
from .builder.actuators import PD as PD
from .builder.actuators import Friction as Friction
from .builder.actuators import Stop as Stop
from .builder.beams import spline as spline
from .builder.builder import ModelBuilder as ModelBuilder
from .builder.joints import GROUND as GROUND
from .builder.reference import Reference as Reference
from .builder.scene import scene as scene
from .elements.sections import Circle as Circle, Rectangle as Rectangle, Section as Section, Tube as Tube
from .time_laws import Control as Control
from .time_laws import Rotation as Rotation
from .materials import SVK as SVK, KelvinVoigt as KelvinVoigt, MooneyRivlin as MooneyRivlin, NeoHookean as NeoHookean
from .model.bodies import Body as Body
from .model.handles import (
    ElementSet as ElementSet,
    MaterialPoint as MaterialPoint,
    NodeSet as NodeSet,
    SurfaceSet as SurfaceSet,
)
from .model.joints import Joint as Joint
from .model.model import Model as Model
from .model.shapes import Box as Box, Capsule as Capsule, Cylinder as Cylinder, HalfSpace as HalfSpace, Sphere as Sphere
from .model.state import State as State
from .model.triangle_mesh import TriMesh as TriMesh
from .outputs.html import HTMLWriter as HTMLWriter
from .outputs.render import GIFWriter as GIFWriter, PNGWriter as PNGWriter
from .outputs.usd import USDWriter as USDWriter
from .outputs.vtk import VTUWriter as VTUWriter
from .outputs.vtk_reader import read_results as read_results
from .simulation import loss as loss
from .simulation import torch as torch
from .simulation.adjoint import Adjoint as Adjoint
from .simulation.checkpoint import Checkpoint as Checkpoint
from .simulation.integrators import EnergyMomentum as EnergyMomentum, GeneralizedAlpha as GeneralizedAlpha
from .simulation.modes import Buckling as Buckling, Modes as Modes, buckling as buckling, modes as modes
from .simulation.observations import Observations as Observations
from .simulation.simulation import Simulation as Simulation, StepReport as StepReport
from .simulation.statics import solve_static as solve_static
from .solvers import Jacobi as Jacobi, NewtonPCG as NewtonPCG
from .studies.accuracy import StudyOptions as StudyOptions, study as study
from .sweeps import Design as Design, fit as fit, sweep as sweep
