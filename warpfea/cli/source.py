"""Resolution of the SCENE argument: scene, user file or mesh; its simulation."""

import argparse
import pathlib
from dataclasses import dataclass
from typing import Any

from ..base.console import compile_progress_bar
from ..base.errors import UsageError
from ..builder.scene import Scene, load_file, locate, split_name
from ..mesh import CAD_FORMATS, FORMATS
from ..model.model import Model
from ..simulation.simulation import Simulation
from ..simulation.statics import begin_static
from ..solvers import SOLVERS
from .arguments import existing_file
from .mesh_scene import MESH_OPTIONS, SURFACE_FORMATS, mesh_scene

__all__ = ["Source", "find_scene", "is_mesh", "load_scenes", "resolve", "show_progress"]

SURFACE_SUFFIXES = (*SURFACE_FORMATS, ".off", ".3mf")
"""Formats of surfaces, without elements."""


@dataclass(frozen=True, eq=False)
class Source:
    """Scene with its parameters and the options of a run.

    Attributes:
        label: text of the argument.
        scene: the scene. values: its arguments.
        parameters: those of the summary.
        dt: step of a motion, s, or "auto".
        place: device and precision of the model.
        static: True for statics. options: of the simulation or of statics.
    """

    label: str
    scene: Scene[Any]
    values: dict[str, Any]
    parameters: dict[str, Any]
    dt: float | str
    place: dict[str, Any]
    static: bool
    options: dict[str, Any]

    def model(self) -> Model:
        """Call the scene and finalize."""
        return self.scene.build(self.values).finalize(**self.place)

    def simulation(self, model: Model, show: bool | None) -> Simulation:
        """The simulation (dynamic, or static with load steps); shows a bar while kernels compile."""
        with compile_progress_bar(show) as bar:
            return (begin_static if self.static else Simulation)(model, on_compile=bar, **self.options)


def show_progress(options: argparse.Namespace) -> bool | None:
    """True to show bars; None: if stderr is a terminal."""
    return False if options.quiet or options.no_progress else None


def is_mesh(options: argparse.Namespace) -> bool:
    """True if SCENE is a mesh file, or a surface or shape to mesh."""
    suffix = pathlib.Path(options.what).suffix.lower()
    return suffix in FORMATS or suffix in CAD_FORMATS or bool(options.size and suffix in SURFACE_FORMATS)


def load_scenes(file: str) -> dict[str, Scene[Any]]:
    """The scenes of a file by name; an error in it is a ModelError with file and line."""
    # absolute: Python stores the file's code under that path, so tracebacks show its lines
    return load_file(existing_file(file).absolute())


def find_scene(what: str) -> Scene[Any]:
    """The scene NAME, file.py or file.py:NAME. ModelError or UsageError lists the known ones."""
    file, _ = split_name(what)
    if file is None:
        _check_suffix(what)
    else:
        existing_file(file)
    return locate(what)


def _check_suffix(what: str) -> None:
    """UsageError for a file that is neither a scene nor a readable mesh."""
    suffix = pathlib.Path(what).suffix
    if not suffix:
        return
    formats = ", ".join(f"{end} ({name})" for end, name in FORMATS.items())
    text = f"{what}: unsupported file type {suffix}: neither a scene (.py) nor a mesh ({formats})"
    if suffix.lower() in SURFACE_SUFFIXES:
        text += f"; {suffix} describes a surface, not elements: fill it with tetrahedra, in Gmsh for example"
        if suffix.lower() in SURFACE_FORMATS:
            text += ", or by --size 2e-3 (edges of 2 mm)"
    raise UsageError(text)


def resolve(options: argparse.Namespace, checkpoint: dict[str, Any] | None = None) -> Source:
    """Scene and options of `run` and `info`; dt, integrator and precision of a checkpoint override the scene's."""
    saved = checkpoint or {}
    if is_mesh(options):
        found, parameters = mesh_scene(options)
        values: dict[str, Any] = {}
    else:
        given = [name for name in MESH_OPTIONS if getattr(options, name)]
        found = find_scene(options.what)
        if given:
            raise UsageError(f"--{given[0].replace('_', '-')} is for mesh files; {options.what} is a scene, use --set")
        values = found.resolve(found.parse_settings(options.set))
        parameters = values
    dt = options.dt or saved.get("dt") or found.dt
    error = options.error or (saved.get("error") if dt == "auto" else None)
    if (error is None) == (dt == "auto"):
        raise UsageError("--dt auto needs --error, such as 1e-4" if dt == "auto" else "--error is for --dt auto")
    static = getattr(options, "static", False)
    how: dict[str, Any] = {"inversion": options.inversion}
    how["check_overlap"] = getattr(options, "overlaps", "ignore") == "warn"
    if static:
        how |= {"load_steps": options.load_steps or 10, "tol": options.tol, "stabilise": options.stabilise}
    else:
        how |= {"dt": dt, "error": error, "energy_growth": options.energy_growth}
        how["integrator"] = options.integrator or saved.get("integrator") or found.integrator
        how["solver"] = SOLVERS[options.solver](tol=options.tol or found.tol)
    place = {"device": options.device, "dtype": options.dtype or saved.get("dtype") or "float64"}
    return Source(options.what, found, values, parameters, dt, place, static, how)
