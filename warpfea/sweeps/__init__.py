"""Sweeps over worlds, cores, GPUs and machines; see SWEEPS.md."""

from .design import Design
from .engines import DaskEngine, PoolEngine, WorkerLost
from .fitting import Fit, fit
from .result import SweepResult
from .study_file import read_study, run_study
from .sweep import sweep

__all__ = [
    "DaskEngine", "Design", "Fit", "PoolEngine", "SweepResult", "WorkerLost", "fit", "read_study", "run_study", "sweep",
]  # fmt: skip
