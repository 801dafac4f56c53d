"""Options of `wf.study` besides the settings of its runs."""

import dataclasses
import functools
import pathlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ParamSpec, TypeVar

from ...base.checks import check_positive
from ...base.errors import ModelError
from ...base.names import check_known
from ...builder.reference import Reference
from .finer import check_finer
from .report import ERROR_MEASURES

__all__ = ["StudyOptions", "refuse_moved_keywords"]

SPLIT_CHOICES = ("best", "all", "none")
Params = ParamSpec("Params")
Returned = TypeVar("Returned")


@dataclass(frozen=True, kw_only=True)
class StudyOptions:
    """Errors, times and files of a study.

    Attributes:
        reference: a wf.Reference, a dict from probes to functions of time or samples, a file (.csv, .json), or "run"
            for a finer run. By default the scene's, else a finer run.
        finer: options and parameters of the finer run, in place of the chosen ones.
        mesh: parameters that refine the mesh; by default cells, elements, across.
        measure: the error used: "l2", "end", "energy" or "field".
        target: requested error of the cheapest setting: in time and, without a swept mesh, including the mesh
            estimate of `split`.
        split: parts of the error: of the "best" row (the answer to the target, else that with most digits of efficacy),
            of "all" rows, or "none".
        repeat: runs of each setting for the times; those longer than 2 s are not repeated.
        limit: time limit of a run, s.
        out: folder for NAME.json, .csv, .png, and NAME.points.jsonl, from which an interrupted study goes on.
        name: of the files; by default that of the scene.
        progress: show a bar; by default if stderr is a terminal.
        what, words: scene on the command line, and the words of that line, for the files.

    Raises:
        ModelError: a value out of range.
    """

    reference: Reference | Mapping[str, Any] | str | pathlib.Path | None = None
    finer: Mapping[str, Any] | None = None
    mesh: Sequence[str] | None = None
    measure: str = "l2"
    target: float | None = None
    split: str = "best"
    repeat: int = 3
    limit: float | None = None
    out: str | pathlib.Path | None = None
    name: str | None = None
    progress: bool | None = None
    what: str | None = None
    words: Sequence[str] | None = None

    def __post_init__(self) -> None:
        if self.name is not None and not re.fullmatch(r"[\w.-]+", self.name):
            raise ModelError(f"study: name {self.name!r} is to be part of names of files: letters, digits, _ - and .")
        for option, known in (("measure", ERROR_MEASURES), ("split", SPLIT_CHOICES)):
            check_known(f"study: {option}", getattr(self, option), known)
        if not (isinstance(self.repeat, int) and self.repeat >= 1):
            raise ModelError(f"study: repeat = {self.repeat!r} must be a positive whole number")
        given = {"target": self.target, "limit": self.limit}
        check_positive("study", **{name: value for name, value in given.items() if value is not None})
        check_finer(self.finer or {})


def refuse_moved_keywords(function: Callable[Params, Returned]) -> Callable[Params, Returned]:
    """The function, with a ModelError for keywords that are fields of StudyOptions."""
    fields = {field.name for field in dataclasses.fields(StudyOptions)}

    @functools.wraps(function)
    def call(*args: Params.args, **given: Params.kwargs) -> Returned:
        moved = [name for name in given if name in fields]
        if moved:
            many = f"{', '.join(moved)} {'is a field' if len(moved) == 1 else 'are fields'}"
            write = ", ".join(f"{name}={given[name]!r}" for name in moved)
            raise ModelError(f"{many} of StudyOptions: study(..., options=wf.StudyOptions({write}))")
        return function(*args, **given)

    return call
