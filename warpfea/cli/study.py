"""`warpfea study`: studies of scenes, and `measuring.STUDIES`; `warpfea stress`."""

import argparse
import contextlib
import importlib

from ..studies.accuracy.options import StudyOptions
from ..studies.accuracy.settings import parse_over
from ..studies.accuracy.study import study as measure
from . import DONE, NOT_CONVERGED
from .source import find_scene, show_progress

__all__ = ["accuracy", "stress", "study"]

SHARED_OPTIONS = ("reference", "mesh", "measure", "target", "split", "repeat", "limit", "out", "name", "what", "words")
"""Fields of StudyOptions that are options of the command line."""


def study(options: argparse.Namespace) -> int:
    """Run `warpfea study STUDY`."""
    with contextlib.redirect_stdout(None) if options.quiet else contextlib.nullcontext():
        importlib.import_module(f"warpfea.studies.{options.study}").run(options)
    return DONE


def accuracy(options: argparse.Namespace) -> int:
    """Run `warpfea study SCENE`; 3 if no setting reaches the target."""
    scene = find_scene(options.what)
    texts = list(options.over)
    texts += [f"method={options.methods}"] if options.methods else []
    texts += [f"error={options.error}"] if options.error else []
    finer = {name: values[0] for name, values in parse_over(scene, options.finer, "--finer").items()}
    result = measure(
        scene,
        over=parse_over(scene, texts),
        parameters=scene.parse_settings(options.set),
        probes=options.probe,
        **{name: getattr(options, name) for name in ("dt", "t_end", "solver", "tol", "dtype", "device")},
        options=StudyOptions(
            finer=finer, progress=show_progress(options), **{k: getattr(options, k) for k in SHARED_OPTIONS}
        ),
    )
    if not options.quiet:
        print(result.table(), flush=True)
    return NOT_CONVERGED if options.target is not None and result.answer is None else DONE


def stress(options: argparse.Namespace) -> int:
    """Run `warpfea stress`; 3 if a row fails its criterion."""
    from ..studies.stress import suite

    return DONE if suite.stress(options) else NOT_CONVERGED
