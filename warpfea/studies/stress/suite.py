"""`warpfea stress`: selects, runs and evaluates rows, prints and writes results."""

import argparse
import importlib
import json
import math
import pathlib
import pkgutil
import sys
import time as clock
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ...base.console import format_number, format_table, quiet_warp, to_json, write_json
from ...base.devices import find_device
from ...base.errors import Error, UsageError
from ...base.names import did_you_mean
from ...base.provenance import provenance_of
from ...base.writer import check_target
from .case import CASES, DTYPES, Answer, Case, Setting, Skipped, label
from .misses import known_miss_reason

__all__ = ["Row", "list_cases", "load_cases", "run_row", "run_rows", "select_rows", "stress"]

SCHEMA = 1
DONE, REFUSED, FAILED, MISSED = "done", "refused", "FAILED", "missed"
STDOUT = "-"
NOTE_WIDTH = 120
"""Characters of a note in the table; the file has the full text."""
COLUMNS = {
    "case": "case", "precision": "precision", "outcome": "outcome", "error": "error", "bound": "bound",
    "Newton": "newton", "PCG": "pcg", "largest step": "largest_step", "drift": "drift", "violation": "violation",
    "s": "wall_s", "note": "note",
}  # fmt: skip
"""Headings of the table -> values of a row."""


@dataclass(frozen=True)
class Row:
    """A case with one of its values, in one precision."""

    case: Case
    value: Any
    dtype: str

    @property
    def label(self) -> str:
        """NAME or NAME/VALUE."""
        return label(self.case.name, self.value)


def load_cases() -> dict[str, Case]:
    """All cases by name, after import of every module of `cases`."""
    from . import cases

    for module in sorted(found.name for found in pkgutil.iter_modules(cases.__path__)):
        importlib.import_module(f"{cases.__name__}.{module}")
    return CASES


def select_rows(cases: Mapping[str, Case], names: Sequence[str], quick: bool, dtypes: Sequence[str]) -> list[Row]:
    """Rows of `names` (cases, rows or groups; none: all). UsageError for an unknown name."""
    known = dict.fromkeys(
        [*cases, *(c.group for c in cases.values()), *(label(c.name, v) for c in cases.values() for v in c.values)]
    )
    for name in names:
        if name not in known:
            hint = did_you_mean(name, known) or f"; there are {', '.join(cases) or 'none'}"
            raise UsageError(f"--case {name}: there is no such case{hint}")
    rows = []
    for case in cases.values():
        for value in case.values:
            called = {case.name, case.group, label(case.name, value)}
            for dtype in dtypes:
                wanted = dtype in case.dtypes and (not quick or case.quick in ("both", dtype))
                if wanted and (not names or called.intersection(names)):
                    rows.append(Row(case, value, dtype))
    if not rows:
        raise UsageError("no row is left: none of these cases is for this precision or in the quick suite")
    return rows


def list_cases(cases: Mapping[str, Case]) -> str:
    """Cases by group, with their values and descriptions."""
    out: list[list[str]] = []
    for group in dict.fromkeys(case.group for case in cases.values()):
        out.append([group])
        for case in cases.values():
            if case.group == group:
                values = ", ".join(label("", value)[1:] for value in case.values if value is not None)
                out.append([f"  {case.name}", case.quick, f"{case.description}{f' [{values}]' if values else ''}"])
    return format_table([["case", "quick", "what is tried [values]"], *out])


def run_row(row: Row, setting: Setting, debug: bool = False) -> dict[str, Any]:
    """Run and evaluate a row: a JSON-compatible dict, `passed` True, False, or None if skipped.

    With `debug` errors other than warpfea's are raised.
    """
    case = row.case
    began = clock.perf_counter()
    answer: Answer | None = None
    try:
        answer = case.run(setting) if row.value is None else case.run(setting, row.value)
        outcome, passed, note = _evaluate_answer(case, answer)
    except Skipped as reason:
        outcome, passed, note = str(reason), None, ""
    except Error as error:
        outcome, passed, note = _evaluate_error(case, error, setting.dtype)
    except Exception as error:
        if debug:
            raise
        outcome, passed, note = FAILED, False, traceback.format_exception_only(error)[-1].strip()
    known = known_miss_reason(row.label, row.dtype, setting.device)
    if known and passed is False:
        outcome, passed, note = MISSED, None, f"{known} ({note})"
    out: dict[str, Any] = {"case": row.label, "group": case.group, "precision": row.dtype}
    out |= {"outcome": outcome, "passed": passed}
    if answer is not None:
        out |= vars(answer) | {"limits": {name: {"value": v, "bound": b} for name, (v, b) in answer.limits.items()}}
        del out["note"]  # the evaluated one comes last
    out |= {"wall_s": clock.perf_counter() - began, "note": note}
    return dict(to_json(out))


def _evaluate_answer(case: Case, answer: Answer) -> tuple[str, bool, str]:
    """Outcome, passed or not, and a note."""
    if case.must_refuse:
        return FAILED, False, f"accepted what is to be refused; {answer.note}".rstrip("; ")
    if answer.passed:
        return DONE, True, answer.note
    over = [f"{name} {format_number(value)} > {format_number(bound)}" for name, (value, bound) in answer.limits.items()
            if not value <= bound]  # fmt: skip
    if not answer.error <= answer.bound:
        over.insert(0, f"accepted wrong: error {format_number(answer.error)} > {format_number(answer.bound)}")
    return FAILED, False, "; ".join([*over, answer.note]).rstrip("; ")


def _evaluate_error(case: Case, error: Error, dtype: str) -> tuple[str, bool, str]:
    """Outcome for a named error: it passes if the refusal is expected with this text."""
    text = " ".join(str(error).split())
    expected = case.refusal.get(dtype, ())
    if any(part in text for part in expected):
        return REFUSED, True, text
    missing_text = f", which does not say {' or '.join(map(repr, expected))}" if expected else ""
    return FAILED, False, f"refused{missing_text}: {type(error).__name__}: {text}"


def run_rows(
    rows: Sequence[Row], device: str, meshes: pathlib.Path | None, content: dict[str, Any], options: argparse.Namespace
) -> None:
    """Run the rows missing in `content["rows"]`; print each, and write the file after each."""
    have = {(row["case"], row["precision"]): row for row in content["rows"]}
    width = max(len(row.label) for row in rows)
    live = sys.stderr.isatty() and not (options.quiet or options.no_progress)
    _print_row(options, dict(zip(COLUMNS, COLUMNS)), width)
    for k, row in enumerate(rows):
        found = have.get((row.label, row.dtype))
        if found is None:
            if live:
                print(f"\r\x1b[K{k + 1}/{len(rows)} {row.label} {row.dtype} ...", end="", file=sys.stderr, flush=True)
            found = run_row(row, Setting(device, row.dtype, meshes), options.debug)
            content["rows"].append(found)
            if options.json and options.json != STDOUT:
                write_json(options.json, content)
        if live:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)
        _print_row(options, _row_texts(found), width)


def _row_texts(row: Mapping[str, Any]) -> dict[str, str]:
    """A row as text, by the heads of the table."""

    def text(name: str) -> str:
        value = row.get(name)
        if value is None:
            return "nan" if name == "error" and "bound" in row else "-"
        if name == "wall_s":
            return f"{value:.1f}"
        return str(value) if isinstance(value, (int, str)) else format_number(value, 3)

    return {heading: text(name) for heading, name in COLUMNS.items()}


def _print_row(options: argparse.Namespace, cells: Mapping[str, str], width: int) -> None:
    """A line of the table on stdout."""
    if not options.quiet and options.json != STDOUT:
        first = [cells["case"].ljust(width), cells["precision"].ljust(9), cells["outcome"].ljust(8)]
        middle = [cells[name].rjust(max(len(name), 8)) for name in list(COLUMNS)[3:-1]]
        note = cells["note"] if len(cells["note"]) <= NOTE_WIDTH else f"{cells['note'][: NOTE_WIDTH - 3]}..."
        print("  ".join([*first, *middle, note]).rstrip(), flush=True)


def _initial_content(options: argparse.Namespace, settings: Mapping[str, Any], device: str) -> dict[str, Any]:
    """Contents of --json before the first row: the rows of the file to resume, or none. UsageError."""
    content = {"schema": SCHEMA, **provenance_of(options.words, device), "settings": dict(settings), "rows": []}
    path = pathlib.Path(options.json) if options.json and options.json != STDOUT else None
    if not options.resume:
        return content
    if path is None:
        raise UsageError("--resume goes on from the file of --json: name it")
    if not path.exists():
        return content
    try:
        before = json.loads(path.read_text())
        same = (before["schema"], before["commit"], before["machine"]["device"]) == (
            SCHEMA, content["commit"], content["machine"]["device"],
        )  # fmt: skip
        rows = [row for row in before["rows"] if row["case"] and row["precision"]]
    except (OSError, ValueError, KeyError, TypeError):
        raise UsageError(f"--resume: {path} is no file of warpfea stress") from None
    if not same:
        raise UsageError(f"--resume: {path} was made by another commit or on another device; begin anew without it")
    return content | {"rows": rows}


def stress(options: argparse.Namespace) -> bool:
    """Run `warpfea stress`; True if every row met its criterion. UsageError, OutputError."""
    cases = load_cases()
    if options.list:
        print(list_cases(cases))
        return True
    dtypes = DTYPES if options.dtype == "both" else (options.dtype,)
    rows = select_rows(cases, options.case, options.quick, dtypes)
    meshes = pathlib.Path(options.meshes) if options.meshes else None
    if meshes is not None and not meshes.is_dir():
        raise UsageError(f"--meshes {meshes}: no such folder")
    if options.json and options.json != STDOUT:
        check_target(options.json, (".json",))
    with quiet_warp():
        device = str(find_device(options.device))
        settings = {"case": options.case, "quick": options.quick, "dtype": options.dtype, "meshes": meshes is not None}
        content = _initial_content(options, settings, device)
        run_rows(rows, device, meshes, content, options)
    if options.json == STDOUT:
        write_json(STDOUT, content)
    wanted = {(row.label, row.dtype) for row in rows}
    return _print_summary(options, [row for row in content["rows"] if (row["case"], row["precision"]) in wanted])


def _print_summary(options: argparse.Namespace, results: Sequence[Mapping[str, Any]]) -> bool:
    """Print the number of passed rows, and the failed ones."""
    wrong = [f"{row['case']} {row['precision']}" for row in results if row["passed"] is False]
    counted = sum(row["passed"] is not None for row in results)
    seconds = math.fsum(row["wall_s"] for row in results)
    if not options.quiet and options.json != STDOUT:
        skipped = len(results) - counted
        left_out = f", {skipped} left out" if skipped else ""
        print(f"\n{counted - len(wrong)} of {counted} rows met their criterion{left_out}, {seconds:.0f} s")
    if wrong:
        print(f"not met: {', '.join(wrong)}", file=sys.stderr, flush=True)
    return not wrong
