"""Case of the stress suite: setting, answer, registration."""

import pathlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

__all__ = ["CASES", "DTYPES", "FLOAT32_REFUSAL", "Answer", "Case", "Setting", "Skipped", "case", "label"]


DTYPES = ("float64", "float32")
"""Precisions."""


class Skipped(Exception):
    """Row that can't be tried here, counted neither way. The text, a few words, is its outcome."""


@dataclass(frozen=True)
class Setting:
    """Setting of a case.

    Attributes:
        device: Warp device.
        dtype: "float64" or "float32".
        meshes: folder of mesh files outside the package, or None.
    """

    device: str
    dtype: str
    meshes: pathlib.Path | None = None

    def mesh(self, name: str) -> pathlib.Path:
        """A file of the folder --meshes. Skipped if missing."""
        if self.meshes is None or not (self.meshes / name).is_file():
            raise Skipped("no mesh")
        return self.meshes / name

    @property
    def single(self) -> bool:
        """True in float32."""
        return self.dtype == "float32"


@dataclass
class Answer:
    """Answer of a case. It passes if every `error` is within its `bound`.

    Attributes:
        error: usually a relative error against `reference`; NaN fails.
        bound: largest error that passes.
        reference: source of the right answer.
        newton, pcg, halvings: of the whole case, the worst world's.
        limits: further numbers that must not exceed a bound, {name: (value, bound)}, such as Newton iterations.
        largest_step: largest stable step found, s.
        drift: of the energy, relative.
        violation: of constraints, over the model's size.
        min_J, floor: as in StepReport, the worst of the case.
        note: a line for the table.
    """

    error: float
    bound: float
    reference: str
    newton: int = 0
    pcg: int = 0
    halvings: int = 0
    limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    largest_step: float | None = None
    drift: float | None = None
    violation: float | None = None
    min_J: float | None = None
    floor: float | None = None
    note: str = ""

    @property
    def passed(self) -> bool:
        """True if everything is within its bound."""
        return self.error <= self.bound and all(value <= bound for value, bound in self.limits.values())


@dataclass(frozen=True)
class Case:
    """A case: a function of the setting, or of the setting and one of `values`, returning an Answer.

    Attributes:
        name: of the case; rows are named NAME or NAME/VALUE.
        group: heading of the table.
        run: the function.
        values: one row each; (None,): a single row.
        quick: rows of the quick suite, "none", "float64" or "both" precisions.
        refusal: {dtype: texts}: precisions in which the case may end with an error of warpfea containing one of
            `texts` instead of an answer; with `must_refuse`, has to.
        must_refuse: an answer fails the case.
        description: one line.
        dtypes: precisions of the case.
    """

    name: str
    group: str
    run: Callable[..., Answer]
    values: Sequence[Any] = (None,)
    quick: str = "none"
    refusal: Mapping[str, Sequence[str]] = field(default_factory=dict)
    must_refuse: bool = False
    description: str = ""
    dtypes: Sequence[str] = DTYPES


def label(name: str, value: Any) -> str:
    """Name of a row: NAME, or NAME/VALUE."""
    if value is None:
        return name
    parts = value if isinstance(value, tuple) else (value,)
    return f"{name}/{'-'.join(f'{x:g}' if isinstance(x, float) else str(x) for x in parts)}"


FLOAT32_REFUSAL = {"float32": ("float32",)}
"""Refusal of rows that float32 can't hold."""
CASES: dict[str, Case] = {}
"""Cases by name, in the order of their definition."""


def case(
    name: str, group: str, *, refusal: Mapping[str, Sequence[str]] | Sequence[str] = (), description: str = "",
    **options: Any,
) -> Callable[[Callable[..., Answer]], Callable[..., Answer]]:  # fmt: skip
    """Add a function to `CASES`; see Case. The first line of its docstring is the default description; refusal without
    precisions is for both."""

    def add(run: Callable[..., Answer]) -> Callable[..., Answer]:
        texts = refusal if isinstance(refusal, Mapping) else dict.fromkeys(DTYPES if refusal else (), refusal)
        about = description or (run.__doc__ or "").strip().splitlines()[0]
        CASES[name] = Case(name, group, run, refusal=texts, description=about, **options)
        return run

    return add
