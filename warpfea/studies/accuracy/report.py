"""Results of a study of error against run time: rows, and their table, CSV, JSON and plot."""

import dataclasses
import itertools
import math
import pathlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, overload

import numpy as np

from ...base.console import format_bytes, format_number, format_table, to_json, write_json
from ...base.errors import OutputError
from ...base.lazy import require_matplotlib
from ...base.provenance import machine, provenance_of, versions
from ...base.short_repr import use_short_repr
from ...base.writer import make_folder, write_atomically
from ..files import write_csv
from .measure import DONE
from .motion import RESOLVED_RATIO
from .settings import Setting, SweepAxes, cli_text

__all__ = ["Row", "Study", "with_orders", "with_pareto"]

SCHEMA = 1
ERROR_MEASURES = ("l2", "end", "energy", "field")


@dataclass(frozen=True)
class Row:
    """One setting.

    Attributes:
        setting: all options of the run. swept: its varied options, by name.
        status, why: "done"; or "failed", "too long" and "refused", with the reason.
        error: by the study's measure, one of the next four; None if there is none.
        l2, end: root of the mean square over time, and at the end, over the largest travel; largest of the probes.
        energy: largest drift of the energy balance over the largest energy exchanged.
        field: of the scene's field at the end, over its norm.
        probes: l2 and end of each probe.
        resolved: the error is at least ten times that of the reference, and above rounding.
        own_error: error of the reference, in the same measure.
        mesh_error: estimated error of the mesh, if `error` is in time alone and a target depends on it.
        orders: observed, from the next coarser row, by swept size.
        seconds, seconds_min: of all steps, median and minimum of `repeats` runs, without compilation and set-up.
        compile_s, setup_s: making the simulation (kernels, graphs), and making the model, in the first run.
        steps, newton, pcg: counts over the run; accepted ones of adaptive steps.
        rough: steps accepted above the tolerance (wf.Jacobi).
        bytes: of the simulation on its device. unknowns, elements: of the model.
        efficacy: digits, -log10(error x seconds).
        pareto: no other row has a smaller error in less time.
        split: parts of the error, see split.py; None if not requested.
        ledger: changes of the terms of the energy ledger over the run, over the largest energy exchanged.
    """

    setting: Setting
    swept: dict[str, Any]
    status: str
    why: str = ""
    error: float | None = None
    l2: float | None = None
    end: float | None = None
    energy: float | None = None
    field: float | None = None
    probes: dict[str, dict[str, float]] = dataclasses.field(default_factory=dict)
    resolved: bool = False
    own_error: float = 0.0
    mesh_error: float | None = None
    orders: dict[str, float] = dataclasses.field(default_factory=dict)
    seconds: float | None = None
    seconds_min: float | None = None
    repeats: int = 0
    compile_s: float | None = None
    setup_s: float | None = None
    steps: int | None = None
    newton: int | None = None
    pcg: int | None = None
    rough: int | None = None
    bytes: int | None = None
    unknowns: int | None = None
    elements: int | None = None
    efficacy: float | None = None
    pareto: bool = False
    split: dict[str, float | None] | None = None
    ledger: dict[str, float] | None = None

    __repr__ = use_short_repr

    @property
    def total_error(self) -> float:
        """Error plus that of the reference and of the mesh, as far as estimated; inf if there is none."""
        return math.inf if self.error is None else self.error + self.own_error + (self.mesh_error or 0.0)

    def curve_key(self, axes: SweepAxes) -> tuple[tuple[str, Any], ...]:
        """Common key of the rows of one curve."""
        curve_axis = ("dt", "error") if axes.curve_axis == "step" else (axes.curve_axis,)
        first = {"method": self.setting.method} | {k: v for k, v in self.swept.items() if k not in curve_axis}
        if axes.curve_axis == "step" and self.setting.error is not None:
            first["steps"] = "adaptive"
        return tuple(first.items())


def mean_size(value: Any) -> float:
    """Size as one number: of a tuple the geometric mean."""
    return float(np.exp(np.mean(np.log(value)))) if isinstance(value, tuple) else float(value)


def with_orders(rows: Sequence[Row], axes: SweepAxes) -> list[Row]:
    """Rows with orders observed from the next coarser one, if both errors are resolved.

    p = log(e1/e2) / log(h1/h2) for a step, with the reciprocal numbers of cells for a mesh, and with the requested
    errors for adaptive steps.
    """
    out = list(rows)
    for name in axes.sizes:
        groups: dict[str, list[int]] = {}
        for k, row in enumerate(rows):
            if row.status == DONE and row.swept.get(name) is not None:
                groups.setdefault(repr({key: v for key, v in row.swept.items() if key != name}), []).append(k)
        for group in groups.values():
            sizes = {k: mean_size(rows[k].swept[name]) ** (-1.0 if name in axes.mesh else 1.0) for k in group}
            group.sort(key=lambda k: -sizes[k])
            for coarse, fine in itertools.pairwise(group):
                a, b = rows[coarse], rows[fine]
                if a.resolved and b.resolved and a.error and b.error:
                    order = math.log(a.error / b.error) / math.log(sizes[coarse] / sizes[fine])
                    out[fine] = replace(out[fine], orders=out[fine].orders | {name: order})
    return out


def with_pareto(rows: Sequence[Row]) -> list[Row]:
    """Rows, with those marked for which no other has a smaller error in at most the same time, or the same in less."""

    def dominated(row: Row) -> bool:
        assert row.error is not None
        assert row.seconds is not None
        return any(
            o.error <= row.error and o.seconds <= row.seconds and (o.error < row.error or o.seconds < row.seconds)
            for o in rows
            if o.error is not None and o.seconds is not None
        )

    return [replace(r, pareto=r.error is not None and r.seconds is not None and not dominated(r)) for r in rows]


@dataclass(frozen=True)
class Study(Sequence[Row]):
    """Study: a sequence of its rows.

    Attributes:
        name: of the scene, and of the files. what: scene on the command line.
        rows: in the order of the sweep.
        axes: what was swept. measure: the error used. target: requested error, or None.
        references: reference solutions of each problem: about, own error, travel, values.
        settings: other options that the numbers depend on.
        answer: the cheapest row that reaches the target; None. command: its command line.
        checks: the answer rerun with about 0.9 and 1.1 times its step, or requested error.
    """

    name: str
    what: str
    rows: list[Row] = dataclasses.field(repr=False)
    axes: SweepAxes = dataclasses.field(repr=False)
    measure: str
    target: float | None
    references: list[dict[str, Any]] = dataclasses.field(repr=False)
    settings: dict[str, Any] = dataclasses.field(repr=False)
    answer: Row | None = dataclasses.field(repr=False)
    command: str | None
    checks: list[Row] = dataclasses.field(default_factory=list, repr=False)

    @overload
    def __getitem__(self, index: int) -> Row: ...
    @overload
    def __getitem__(self, index: slice) -> list[Row]: ...
    def __getitem__(self, index: int | slice) -> Row | list[Row]:
        return self.rows[index]

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[Row]:
        return iter(self.rows)

    def __repr__(self) -> str:
        found = "" if self.target is None else f", target {self.target:g} {'reached' if self.answer else 'not reached'}"
        return f"Study({self.name!r}, {len(self.rows)} rows{found})"

    @property
    def kind(self) -> str:
        """Scope of the error: "in time" alone, against finer steps on the same mesh, or "in time and mesh"."""
        swept = any(name in self.axes.over for name in self.axes.mesh)
        known = self.references and all(ref.get("known", False) for ref in self.references)
        return "in time and mesh" if swept or known else "in time"

    def curves(self) -> dict[str, list[Row]]:
        """Rows by curve, as text."""
        out: dict[str, list[Row]] = {}
        for row in self.rows:
            texts = [cli_text(v) if k == "method" else f"{k}={cli_text(v)}" for k, v in row.curve_key(self.axes)]
            out.setdefault(" ".join(texts), []).append(row)
        return out

    def fits(self) -> list[dict[str, Any]]:
        """Order of each curve along its own size, by least squares over the resolved rows."""
        out: list[dict[str, Any]] = []
        for label, rows in self.curves().items():
            curve_axis = self.axes.curve_axis
            if curve_axis == "step":
                curve_axis = "dt" if rows[0].setting.error is None else "error"
            good = [r for r in rows if r.resolved and r.error and r.swept.get(curve_axis or "") is not None]
            if curve_axis in self.axes.sizes and len(good) > 1:
                sizes = np.log([mean_size(r.swept[curve_axis]) for r in good])
                slope = float(np.polyfit(sizes, np.log([r.error or 1.0 for r in good]), 1)[0])
                slope = -slope if curve_axis in self.axes.mesh else slope
                out.append({"curve": label, "size": curve_axis, "order": slope, "rows": len(good)})
        return out

    def omissions(self) -> list[str]:
        """Text of data missing in the picture."""
        reasons: dict[str, list[str]] = {}
        for r in self.rows:
            if r.status != DONE:
                reasons.setdefault(f"{r.status}: {r.why}", []).append(self.label(r))
        out = [f"{'; '.join(labels)}: {reason}" for reason, labels in reasons.items()]
        near = [self.label(r) for r in self.rows if r.status == DONE and not r.resolved]
        if near:
            limit = f"within {RESOLVED_RATIO:g} times the error of the reference, or rounding"
            out.append(f"not resolved ({limit}): {'; '.join(near)}")
        return out

    def label(self, row: Row) -> str:
        """Text of a row."""
        given = {"method": row.setting.method} | row.swept
        return ", ".join(("" if k == "method" else f"{k}=") + cli_text(v) for k, v in given.items() if v is not None)

    def table(self) -> str:
        """Readable text of the study."""
        head = ["method", *(k for k in self.axes.over if k != "method"), self.measure, *(f"order {s}" for s in
                self.axes.sizes), "end" if self.measure != "end" else "l2", "energy"]  # fmt: skip
        head += ["s", "s min", "digits", "steps", "Newton", "PCG", "memory", ""]
        lines = [head, *([*self._row_texts(row, head)] for row in self.rows)]
        text = [format_table(lines, right=range(1, len(head) - 1)), ""]
        for ref in self.references:
            at = ", ".join(f"{k} = {cli_text(v)}" for k, v in ref["values"].items())
            own = ", ".join(f"{k} {format_number(v, 2)}" for k, v in ref["own_error"].items())
            text.append(f"reference{f' at {at}' if at else ''}: {ref['about']}; its own error: {own or 'none'}")
        travel = ", ".join(format_number(r["travel"]) for r in self.references)
        text.append(f"errors {self.kind}, over the largest travel, {travel} m")
        text += [f"order {f['order']:.2f} in {f['size']} of {f['curve']}, {f['rows']} rows" for f in self.fits()]
        for row in self.rows:
            if row.split is not None:
                parts = ", ".join(f"{k} {'-' if v is None else format_number(v, 2)}" for k, v in row.split.items())
                text.append(f"parts of the error of {self.label(row)}: {parts}")
        text += [f"left out: {line}" for line in self.omissions()]
        done = [r for r in self.rows if r.compile_s is not None]
        if done:
            compiled, made = (max(getattr(r, k) for r in done) for k in ("compile_s", "setup_s"))
            text.append(f"apart from that, at most {compiled:.1f} s to compile and record, {made:.1f} s for the model")
        where = machine(self.rows[0].setting.device)
        known = versions()
        text.append(f"{where.get('gpu', where['cpu'])}, warpfea {known['warpfea']}, Warp {known['warp']}")
        if self.target is not None:
            text += ["", self.verdict()]
        return "\n".join(text)

    def verdict(self) -> str:
        """The answer to the target."""
        if self.answer is not None:
            r = self.answer
            found = f"error {format_number(r.error or 0.0, 3)} in {format_number(r.seconds or 0.0, 3)} s"
            if self.kind == "in time":
                mesh = "not estimated" if r.mesh_error is None else f"of {format_number(r.mesh_error, 2)} included"
                found += f" (in time; mesh error {mesh})"
            text = f"cheapest that reaches {self.target:g}: {self.label(r)}: {found}\n  {self.command}"
            for c in self.checks:
                size = f"error={cli_text(c.setting.error)}" if c.setting.error else f"dt={cli_text(c.setting.dt)}"
                text += f"\nchecked with {size}: " + (c.why if c.error is None else f"error {c.error:.3g}")
            return text
        near = min(self.rows, key=lambda r: r.total_error)
        if near.error is None:
            return f"no setting was measured to reach {self.target:g}"
        if near.mesh_error is not None and near.error + near.own_error <= (self.target or 0.0):
            missed = f"mesh error {format_number(near.mesh_error, 2)}"
            if near.mesh_error <= (self.target or 0.0):
                missed = f"with {missed} the sum {format_number(near.total_error, 3)}"
            found = f"error {format_number(near.error, 3)} in {format_number(near.seconds or 0.0, 3)} s"
            more = f"refine {', '.join(self.axes.mesh)}"
            return f"reached in time; {missed} misses {self.target:g}: {self.label(near)}: {found}; {more}"
        own = f" (and {format_number(near.own_error, 2)} of the reference)" if near.own_error else ""
        return f"no setting was measured to reach {self.target:g}; nearest: {self.label(near)}: {near.error:.3g}{own}"

    def _row_texts(self, row: Row, head: Sequence[str]) -> Iterator[str]:
        other = "end" if self.measure != "end" else "l2"
        values: dict[str, str] = {"method": row.setting.method}
        values |= {
            k: "-" if row.swept.get(k) is None else cli_text(row.swept[k]) for k in self.axes.over if k != "method"
        }
        for name in {self.measure, other, "energy"}:
            value = getattr(row, name)
            values[name] = "-" if value is None else f"{value:.2e}"
        values |= {f"order {s}": f"{row.orders[s]:.2f}" if s in row.orders else "-" for s in self.axes.sizes}
        for name, key in (("s", "seconds"), ("s min", "seconds_min")):
            value = getattr(row, key)
            values[name] = "-" if value is None else f"{value:.3g}"
        values["digits"] = "-" if row.efficacy is None else f"{row.efficacy:.2f}"
        values |= {k: "-" if v is None else str(v) for k, v in
                   (("steps", row.steps), ("Newton", row.newton), ("PCG", row.pcg))}  # fmt: skip
        values["memory"] = "-" if row.bytes is None else format_bytes(row.bytes)
        marks = ["Pareto"] * row.pareto + ["not resolved"] * (row.status == DONE and not row.resolved)
        marks += [] if row.status == DONE else [row.status.upper()]
        values[""] = ", ".join(marks + ["target"] * (row is self.answer))
        return (values[name] for name in head)

    def content(self, words: Sequence[str]) -> dict[str, Any]:
        """Contents of the JSON file."""
        return {
            "schema": SCHEMA, **provenance_of(words, self.rows[0].setting.device), "scene": self.what,
            "measure": self.measure, "target": self.target, "settings": to_json(self.settings),
            "over": to_json(self.axes.over), "references": to_json(self.references), "orders": self.fits(),
            "answer": None if self.answer is None else {"row": self.rows.index(self.answer), "command": self.command},
            "checks": [to_json(asdict(row)) for row in self.checks],
            "rows": [to_json(asdict(row)) for row in self.rows],
        }  # fmt: skip

    def write(self, folder: str | pathlib.Path, words: Sequence[str] = ("study",)) -> list[pathlib.Path]:
        """Write NAME.json, NAME.csv and, with matplotlib, NAME.png into a folder; returns their paths.

        words: of the command line, without "warpfea".

        Raises:
            OutputError: a folder that can't be created or written.
        """
        from .plot import draw

        out = make_folder(folder)
        paths = [out / f"{self.name}.{suffix}" for suffix in ("json", "csv", "png")]
        write_json(str(paths[0]), self.content(words))
        rows = [self._flat_row(row) for row in self.rows]
        write_csv(paths[1], list(dict.fromkeys(key for row in rows for key in row)), rows)
        try:
            require_matplotlib()
        except OutputError:
            return paths[:2]
        write_atomically(paths[2], lambda path: draw(self, path))
        return paths

    def _flat_row(self, row: Row) -> dict[str, Any]:
        """A row without nesting, for the CSV."""
        out = {k: v for k, v in to_json(asdict(row)).items() if not isinstance(v, dict)}
        given = to_json(asdict(row.setting))
        given["asked error"] = given.pop("error")  # `error` is the measured one
        out = {k: v for k, v in given.items() if k != "values"} | out
        out = {f"set {k}": v for k, v in row.setting.values.items()} | out
        out |= {f"order {k}": v for k, v in row.orders.items()}
        out |= {f"ledger {k}": v for k, v in (row.ledger or {}).items()}
        return out | {f"{name} {k}": v for name, p in row.probes.items() for k, v in p.items()}
