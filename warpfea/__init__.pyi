"""What type checkers see of warpfea: the names of `__init__.py`, and `study`, which it loads when it is asked for."""

from . import mesh as mesh
from .base.errors import (
    CapacityError as CapacityError,
)
from .base.errors import (
    CheckpointError as CheckpointError,
)
from .base.errors import (
    ConstraintError as ConstraintError,
)
from .base.errors import (
    ConvergenceError as ConvergenceError,
)
from .base.errors import (
    Error as Error,
)
from .base.errors import (
    MeshError as MeshError,
)
from .base.errors import (
    MeshWarning as MeshWarning,
)
from .base.errors import (
    ModelError as ModelError,
)
from .base.errors import (
    OutputError as OutputError,
)
from .base.errors import (
    PenetrationError as PenetrationError,
)
from .base.version import __version__ as __version__
from .builder.beams import spline as spline
from .builder.builder import ModelBuilder as ModelBuilder
from .builder.joints import GROUND as GROUND
from .builder.reference import Reference as Reference
from .builder.scene import scene as scene
from .elements.sections import Rectangle as Rectangle
from .laws import Control as Control
from .materials import SVK as SVK
from .materials import KelvinVoigt as KelvinVoigt
from .materials import MooneyRivlin as MooneyRivlin
from .materials import NeoHookean as NeoHookean
from .model.bodies import Body as Body
from .model.description import Rotation as Rotation
from .model.handles import (
    ElementSet as ElementSet,
)
from .model.handles import (
    MaterialPoint as MaterialPoint,
)
from .model.handles import (
    NodeSet as NodeSet,
)
from .model.handles import (
    SurfaceSet as SurfaceSet,
)
from .model.joints import Joint as Joint
from .model.model import Model as Model
from .model.shapes import Box as Box
from .model.shapes import Capsule as Capsule
from .model.shapes import Cylinder as Cylinder
from .model.shapes import HalfSpace as HalfSpace
from .model.shapes import Sphere as Sphere
from .model.state import State as State
from .model.triangle_mesh import TriMesh as TriMesh
from .outputs.render import GIFWriter as GIFWriter
from .outputs.render import PNGWriter as PNGWriter
from .outputs.usd import USDWriter as USDWriter
from .outputs.vtk import VTUWriter as VTUWriter
from .simulation.checkpoint import Checkpoint as Checkpoint
from .simulation.integrators import GeneralizedAlpha as GeneralizedAlpha
from .simulation.observations import Observations as Observations
from .simulation.simulation import Simulation as Simulation
from .simulation.simulation import StepReport as StepReport
from .simulation.statics import solve_static as solve_static
from .solvers import Jacobi as Jacobi
from .solvers import NewtonPCG as NewtonPCG
from .studies.accuracy import study as study
