"""Resolution of the SCENE argument: scene, user file or mesh; its simulation."""

import argparse
import pathlib
from dataclasses import dataclass
from typing import Any

from ..base.console import compile_progress_bar
from ..base.errors import UsageError
from ..builder.scene import Scene, load_file, locate, split_name
from ..mesh import FORMATS
from ..model.model import Model
from ..simulation.simulation import Simulation
from ..simulation.statics import begin_static
from ..solvers import SOLVERS
from .arguments import existing_file
from .mesh_scene import MESH_OPTIONS, mesh_scene

__all__ = ["Source", "find_scene", "is_mesh", "load_scenes", "resolve", "show_progress"]

SURFACE_SUFFIXES = (".stl", ".obj", ".ply", ".off", ".step", ".stp", ".iges", ".igs", ".brep", ".geo", ".3mf")
"""Formats of surfaces and shapes, without elements."""


@dataclass(frozen=True, eq=False)
class Source:
    """Scene with its parameters and the options of a run.

    Attributes:
        label: text of the argument.
        scene: the scene. values: its arguments.
        parameters: those of the summary.
        dt, integrator, dtype, device, tol, solver, inversion, error, energy_growth: of the run.
        load_steps, static_tol: of statics; None: a motion, the solver's default. stabilise: of statics.
    """

    label: str
    scene: Scene[Any]
    values: dict[str, Any]
    parameters: dict[str, Any]
    dt: float | str
    integrator: str
    dtype: str
    device: str | None
    tol: float | None
    solver: str
    inversion: str
    load_steps: int | None = None
    static_tol: float | None = None
    stabilise: bool = False
    error: float | None = None
    energy_growth: str = "refuse"

    def model(self) -> Model:
        """Call the scene and finalize."""
        return self.scene.build(self.values).finalize(device=self.device, dtype=self.dtype)

    def simulation(self, model: Model, show: bool | None) -> Simulation:
        """The simulation (dynamic, or static with load steps); shows a bar while kernels compile."""
        if self.load_steps is not None:
            with compile_progress_bar(show) as bar:
                return begin_static(
                    model,
                    load_steps=self.load_steps,
                    tol=self.static_tol,
                    inversion=self.inversion,
                    stabilise=self.stabilise,
                    on_compile=bar,
                )
        solver = SOLVERS[self.solver](tol=self.tol)
        with compile_progress_bar(show) as bar:
            return Simulation(
                model,
                dt=self.dt,
                error=self.error,
                integrator=self.integrator,
                solver=solver,
                inversion=self.inversion,
                energy_growth=self.energy_growth,
                on_compile=bar,
            )


def show_progress(options: argparse.Namespace) -> bool | None:
    """True to show bars; None: if stderr is a terminal."""
    return False if options.quiet or options.no_progress else None


def is_mesh(what: str) -> bool:
    """True if SCENE is a mesh file."""
    return pathlib.Path(what).suffix.lower() in FORMATS


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
        text += f"; {suffix} describes a surface or a shape, not elements: fill it with tetrahedra, in Gmsh for example"
    raise UsageError(text)


def resolve(options: argparse.Namespace, checkpoint: dict[str, Any] | None = None) -> Source:
    """Scene and options of `run` and `info`; dt, integrator and precision of a checkpoint override the scene's."""
    saved = checkpoint or {}
    if is_mesh(options.what):
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
    return Source(
        label=options.what,
        scene=found,
        values=values,
        parameters=parameters,
        dt=dt,
        integrator=options.integrator or saved.get("integrator") or found.integrator,
        dtype=options.dtype or saved.get("dtype") or "float64",
        device=options.device,
        tol=options.tol or found.tol,
        solver=options.solver,
        inversion=options.inversion,
        load_steps=(options.load_steps or 10) if getattr(options, "static", False) else None,
        static_tol=options.tol,
        stabilise=getattr(options, "stabilise", False),
        error=error,
        energy_growth=options.energy_growth,
    )
