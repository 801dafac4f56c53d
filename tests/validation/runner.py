"""`python -m tests.validation NAME`: runs a table, prints its rows, writes them."""

from __future__ import annotations

import argparse
import contextlib
import importlib
import json
import pathlib
import re
import shlex
import sys
import time as clock
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NoReturn

import warpfea as wf
from warpfea.base.console import quiet_warp, to_json, write_json
from warpfea.base.devices import find_device
from warpfea.base.errors import UsageError
from warpfea.base.names import did_you_mean
from warpfea.base.provenance import provenance_of
from warpfea.base.writer import check_target

from .table import Part, Row, Run, Table

__all__ = ["find", "main", "names", "parse", "run"]

HERE = pathlib.Path(__file__).resolve().parent
SCHEMA = 1
EXAMPLES = """\
examples:
  python -m tests.validation --list                     the tables, what each compares and the files it made
  python -m tests.validation floor --help               parts, settings and commands of one
  python -m tests.validation floor --quick              a trial: few rows, nothing written
  python -m tests.validation contact --only hertz --only mindlin --out hertz.json
  python -m tests.validation joints --set joints=10,100 --set steps=20

From the root of a checkout. --out replaces the file; with --only the other parts stay in it as they are. Long parts
keep a checkpoint beside --out: the same command goes on from it after Ctrl-C.

exit codes: 0 done, 2 bad input or usage, 3 a step was refused, 4 output failed, 130 interrupted (the file is valid)
"""


class _Parser(argparse.ArgumentParser):
    """Help that keeps its line breaks; errors as UsageError."""

    def __init__(self, **options: Any) -> None:
        super().__init__(formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False, **options)

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message} ({self.prog} --help explains)")


def names() -> list[str]:
    """Names of the tables: modules and packages of this folder that hold a TABLE."""
    files = [*HERE.glob("*.py"), *HERE.glob("*/__init__.py")]
    found = [path for path in files if re.search(r"^TABLE\b", path.read_text(), re.MULTILINE)]
    return sorted(path.parent.name if path.name == "__init__.py" else path.stem for path in found)


def find(name: str) -> Table:
    """The table of a name. UsageError."""
    if name not in names():
        raise UsageError(f"no table {name!r}: {', '.join(names())}{did_you_mean(name, names())}")
    table = importlib.import_module(f"{__package__}.{name}").TABLE
    assert isinstance(table, Table), name
    return table


def parse(words: Sequence[str]) -> tuple[Table | None, argparse.Namespace]:
    """The table, None for --list, and the options. UsageError; SystemExit after --help."""
    about = "Runs a table of validation: numbers beside references that were not made with warpfea, or costs."
    prog = "python -m tests.validation"
    if not words or words[0].startswith("-"):
        top = _Parser(prog=prog, description=about, epilog=EXAMPLES)
        top.add_argument("--list", action="store_true", help="the tables, what each compares and the files it made")
        top.add_argument("name", nargs="?", metavar="NAME", help="of a table: " + ", ".join(names()))
        options = top.parse_args(words)
        if not options.list:
            raise UsageError(f"name a table: {', '.join(names())} ({prog} --help explains)")
        return None, options
    table = find(words[0])
    lines = ["parts:", *(f"  {name:18}  {_first(_doc(part))}" for name, part in table.parts.items())]
    if table.options:
        lines += ["", "options of --set:", *(f"  {name} = {value}" for name, value in table.options.items())]
    lines += ["", f"takes {table.takes} on two cores", "", "commands of the files in tests/results:"]
    lines += [f"  {file}: {prog} {command}" for file, command in table.results.items()]
    own = _Parser(prog=f"{prog} {words[0]}", description=table.about, epilog="\n".join(lines))
    own.add_argument("--out", metavar="FILE", help="JSON with command, machine, settings and rows")
    own.add_argument("--device", help=f"cpu, cuda:0, ... (default {table.device})")
    own.add_argument("--only", action="append", choices=tuple(table.parts), metavar="PART", help="repeatable")
    own.add_argument("--rows", action="append", default=[], metavar="LABEL", help="rows by label, * for any text")
    own.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="an option; lists with commas")
    own.add_argument("--quick", action="store_true", help="a trial: few and small rows, no result")
    own.add_argument("--quiet", action="store_true", help="no rows on the terminal")
    return table, own.parse_args(words[1:])


def main(words: Sequence[str] | None = None) -> int:
    """Do a command line; the exit code."""
    words = list(sys.argv[1:] if words is None else words)
    try:
        table, options = parse(words)
        if table is None:
            for name in names():
                print(f"{name}: {_first(find(name).about)}")
                print("".join(f"    {file}\n" for file in find(name).results), end="")
            return 0
        labels = tuple(label for text in options.rows for label in text.split(","))
        out = options.out and pathlib.Path(options.out)
        given = Run(options.device or table.device, options.quick, labels, out, table.changed(options.set))
        with contextlib.redirect_stdout(None) if options.quiet else contextlib.nullcontext():
            run(table, given, options.only, words)
        return 0
    except SystemExit as leave:  # --help
        return int(leave.code or 0)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except wf.Error as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        refused = isinstance(error, (wf.ConvergenceError, wf.ConstraintError))
        return 3 if refused else 4 if isinstance(error, wf.OutputError) else 2


def run(table: Table, given: Run, only: Sequence[str] | None = None, words: Sequence[str] = ()) -> dict[str, Any]:
    """Run the parts one after another, print their rows, write the file after each; what the file holds."""
    find_device(given.device)
    if given.out is not None:
        check_target(given.out, (".json",))
    if table.check is not None:
        table.check(given)
    kept = given.out is not None and only and given.out.exists()
    content: dict[str, Any] = json.loads(given.out.read_text()) if given.out is not None and kept else {}
    content |= {"schema": SCHEMA} | ({} if table.apart else _origin(words, given, table))
    if table.apart:
        content.setdefault("parts", {})
    given.made |= {
        name: content["parts"][name]["rows"] if table.apart else content[name]
        for name in table.parts
        if name in (content["parts"] if table.apart else content)
    }
    with quiet_warp():
        for name in only or table.parts:
            began = clock.perf_counter()
            print(f"{name} ...", flush=True)
            given.made[name] = _collect(table.parts[name](given), table.columns)
            seconds = clock.perf_counter() - began
            print(f"{name}: {seconds:.0f} s", flush=True)
            if table.apart:
                part = {"about": _doc(table.parts[name]), "rows": given.made[name], "wall_s": seconds}
                content["parts"][name] = part | _origin(words, given, table)
            else:
                content[name] = given.made[name]
            if given.out is not None and (not given.labels or any(given.made.values())):
                write_json(str(given.out), to_json(content))
    if given.labels and not any(given.made.values()):
        raise UsageError(f"--rows {','.join(given.labels)}: no such row")
    return content


def show(row: Mapping[str, Any], columns: Sequence[str] = ()) -> None:
    """A row as one line: names and values of the columns, of all without any."""
    shown = {name: row[name] for name in columns or row if name in row}
    print("  ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in shown.items()), flush=True)


def _collect(found: Iterable[Row] | Mapping[str, Any], columns: Sequence[str]) -> Any:
    """The rows, each printed as it comes."""
    if isinstance(found, Mapping):
        show(found)
        return dict(found)
    rows = []
    for row in found:
        show(row, columns)
        rows.append(row)
    return rows


def _origin(words: Sequence[str], given: Run, table: Table) -> dict[str, Any]:
    """Command, commit, machine, versions and settings."""
    command = shlex.join(["python", "-m", "tests.validation", *words])
    settings = {**table.settings, **given.options} | ({"quick": True} if given.quick else {})
    return provenance_of([], given.device) | {"command": command} | ({"settings": settings} if settings else {})


def _doc(part: Part) -> str | None:
    """Docstring of a part, also of one given as a `functools.partial`."""
    return getattr(part, "func", part).__doc__


def _first(text: str | None) -> str:
    """First sentence or line of a docstring."""
    return (text or "").strip().partition("\n")[0]
