"""Removal of one mechanism or constant at a time: rows of the stress suite and random cases that are lost without it.

`python tests/ablation.py --out FILE [--only NAME ...] [--suite quick] [--jobs 2] [--rows scenes] [--base FILE]`

Each variant is a copy of the sources with a mechanism switched off (`MECHANISMS`: a text in place of another) or a
constant without effect (`CONSTANTS`: a value that disables it). The stress suite, 200 seeded random models
(random_cases.py), scenes (scene_counts.py), the pile of cubes of 4^3 cells (validation/piles.py) or tests are run with
the copy and with the unchanged sources, in processes side by side. A row is lost if it met its criterion before and
does not now; it is touched if its iterations or its error differ; iterations or work of a scene may rise. A run that is
cut short goes on from the rows that FILE has.
NAME+NAME+... switches several off at once: what may go must go together, and the rows that a group loses (`--case`)
tell which of its members stay.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from random_cases import same
from scene_counts import COUNTS

__all__ = ["CONSTANTS", "MECHANISMS", "Constant", "constant_file", "disabled", "variants"]

ROOT = pathlib.Path(__file__).resolve().parents[1]
Row = dict[str, Any]
COPIED = ("kernels", "warpfea", "scenes", "tests")
SEARCH, CONVERGENCE, NEWTON = (f"kernels/solvers/{name}.py" for name in ("line_search", "convergence", "newton"))
RANDOM_CASES = 200
MIN_RISE, MIN_COUNT = 1.1, 20
"""Ratio of a count of a scene without a constant to that with it, above which the constant is needed; the smallest
count with it that is compared."""
LONG_ROWS = ("rest-1e6", "soft-")
"""Beginnings of rows left out: a million steps, and meshes that the package does not contain."""

Change = tuple[str, str, str]
"""File, text, and the text in its place."""

MECHANISMS: dict[str, tuple[Change, ...]] = {
    "Armijo": ((SEARCH, "good = change <= f64(ARMIJO_FACTOR)", "good = True or change <= f64(ARMIJO_FACTOR)"),),
    "slope fallback": ((SEARCH, "if wp.abs(change) > noise:", "if True:"),),
    "nonmonotone trials": ((SEARCH, "            ctl.search.trials[world] == 0\n", "            False\n"),),
    "watchdog": ((SEARCH, "elif ctl.nonmonotone.steps[world] >= MAX_NONMONOTONE and", "elif False and"),),
    "predicted stress": (
        (SEARCH, "predicted_stress[world] = 1\n", "predicted_stress[world] = 0\n"),
        (SEARCH, "wp.where(tangent_needed(ctl, world), 0, 1)", "0"),
        (SEARCH, "wp.where(tangent_needed(ctl, world), 0, 2)", "0"),
        (NEWTON, "wp.where(searching.tangent_needed(ctl, world), 0, 2)", "0"),
    ),
    "kink search": ((SEARCH, "if wp.static(traits.unilateral and not traits.midpoint):", "if wp.static(False):"),),
    "excursions": ((SEARCH, "ctl.nonmonotone.penetrating_steps[world] < MAX_PENETRATING_STEPS", "False"),),
    "floor estimate": (
        (CONVERGENCE, "near = near and ctl.floor.estimates[world] < MAX_ERROR_ESTIMATES", "near = False"),
        (CONVERGENCE, "near = at_roundoff and ctl.floor.estimates[world] < MAX_ERROR_ESTIMATES", "near = False"),
    ),
    "candidate starts": ((NEWTON, "if is_poor_first_iterate(ctl, world):", "if False:"),),
    "rest below round-off": ((CONVERGENCE, "settling = settling or (bare and", "settling = settling or (False and"),),
    "doublings": ((SEARCH, "longer = (\n            good\n", "longer = (\n            False\n"),),
}
"""Mechanisms of globalisation -> changes that switch them off."""


@dataclass(frozen=True)
class Constant:
    """A tuned constant.

    Attributes:
        area: "Newton and PCG", "reuse", "adaptive and predictor" or "contact".
        unit: of its value.
        disabled: value that takes its effect away.
        rows: part of the stress suite that it can act on: a beginning of groups; empty: all.
    """

    area: str
    unit: str
    disabled: float
    rows: str = ""


NEWTON_PCG, REUSE, ADAPTIVE, CONTACT = "Newton and PCG", "reuse", "adaptive and predictor", "contact"
CONSTANTS: dict[str, Constant] = {
    "EXTRAPOLATED_TOL_FACTOR": Constant(NEWTON_PCG, "tol", 1.0),
    "UNSOLVED_TOL_FACTOR": Constant(NEWTON_PCG, "tol", 1.0),
    "STALL_RATIO": Constant(NEWTON_PCG, "1", 0.0),
    "TIGHT_CONSTRAINT_ITERATIONS": Constant(NEWTON_PCG, "iterations", 0),
    "STALL_ROUNDINGS": Constant(NEWTON_PCG, "roundings of the positions", 1.0),
    "MAX_STALL_STEP": Constant(NEWTON_PCG, "accepted errors", 1.0e300),
    "EXTRA_ITERATION_FACTOR": Constant(NEWTON_PCG, "max_newton", 0),
    "STALL_ENERGY_ROUNDINGS": Constant(NEWTON_PCG, "eps", 0.0),
    "NOISE_DOMINATED_ROUNDINGS": Constant(NEWTON_PCG, "roundings of the positions", 0.0),
    "VELOCITY_ROUNDINGS": Constant(NEWTON_PCG, "roundings of the velocities", 0.0),
    "CHAIN_SHARE": Constant(NEWTON_PCG, "kappa", 0.0),
    "GROUP_ROUNDINGS": Constant(NEWTON_PCG, "roundings of the positions", 0.0),
    "MAX_REUSED_BACKTRACKS": Constant(NEWTON_PCG, "halvings", 20),
    "RADIUS_SHRINK": Constant(NEWTON_PCG, "1", 1.0),
    "MAX_TRUST_RADIUS": Constant(NEWTON_PCG, "1", 1.0e300),
    "SOLVES_WITHOUT_STEP": Constant(NEWTON_PCG, "solves", 1000000),
    "DISPLACEMENT_ROUNDINGS": Constant(NEWTON_PCG, "roundings of the displacements", 0.0),
    "ALTERNATIVE_START_FORCING": Constant(NEWTON_PCG, "1", 1.0e-3),
    "MAX_START_ENERGY_RATIO": Constant(NEWTON_PCG, "kinetic energies", 1.0),
    "CONSTRAINT_FORCING": Constant(NEWTON_PCG, "1", 1.0),
    "UNCHECKED_ITERATIONS": Constant(NEWTON_PCG, "iterations", 0),
    "MIN_ENERGY_GAIN": Constant(NEWTON_PCG, "1", 0.0),
    "SCATTER_FACTOR": Constant(NEWTON_PCG, "1", 0.0),
    "STIFFNESS_RATIO": Constant(NEWTON_PCG, "1", 1.0e300),
    "RESIDUAL_GROWTH": Constant(NEWTON_PCG, "1", 1.0e300),
    "FROZEN_UPDATE_RESIDUAL": Constant(NEWTON_PCG, "1", 1.0e300),
    "ESTIMATE_RESIDUAL": Constant(NEWTON_PCG, "1", 1.0e-8),
    "MAX_STALLED_ITERATIONS": Constant(NEWTON_PCG, "iterations", 1000000),
    "START_STRESS_RESIDUAL": Constant(NEWTON_PCG, "1", 0.0),
    "CONTACT_ROUNDINGS": Constant(NEWTON_PCG, "roundings of the positions", 0.0),
    "PHI_NOISE_ROUNDINGS": Constant(NEWTON_PCG, "roundings of Phi", 0.0),
    "CONTINUATION_START": Constant(NEWTON_PCG, "iterations", 1000000, "contact"),
    "SOFTEST_PENALTY": Constant(NEWTON_PCG, "1", 1.0, "contact"),
    "PENALTY_RATIO": Constant(NEWTON_PCG, "1", 1.0e300, "contact"),
    "NEW_MATRIX_DECADES": Constant(REUSE, "decades", 1.0e3),
    "REDUCTION_FADING": Constant(REUSE, "1", 1.0),
    "REUSED_FORCING_FACTOR": Constant(REUSE, "1", 1.0),
    "ORDER_MARGIN": Constant(ADAPTIVE, "1", 1.0),
    "STARTUP_STEPS": Constant(ADAPTIVE, "steps", 0.0),
    "ERROR_FRACTION": Constant(ADAPTIVE, "requested error", 1.0),
    "MIN_STEP_RATIO": Constant(ADAPTIVE, "mean step", 0.0),
    "STEP_MEMORY": Constant(ADAPTIVE, "substeps", 1.0),
    "RATE_MEMORY": Constant(ADAPTIVE, "substeps", 1.0),
    "RATE_RATIO": Constant(ADAPTIVE, "1", 1.0),
    "ROUNDING_UNITS": Constant(ADAPTIVE, "round-offs", 0.0),
    "SLOW_REDUCTION": Constant(CONTACT, "1", 1.0e300, "contact"),
    "MIN_APPROACH_SPEED": Constant(CONTACT, "m/s", 1.0e-30, "contact"),
    "MIN_NORMAL_COSINE": Constant(CONTACT, "1", -2.0, "contact"),
    "TUNNEL_LIMIT_RATIO": Constant(CONTACT, "depth limit", 1.0e300, "contact"),
    "OPPOSING_COSINE": Constant(CONTACT, "1", 2.0, "contact"),
    "MAX_DEPTH_RATIO": Constant(CONTACT, "deepest penetration", 0.0, "contact"),
    "MAX_EDGE_TANGENT": Constant(CONTACT, "1", 0.0, "contact"),
    "OUTSIDE_TOLERANCE": Constant(CONTACT, "facets", 1.0e-9, "contact"),
    "MASTER_SIZE_RATIO": Constant(CONTACT, "1", 1.0e300, "contact"),
    "MAX_CORNER_LENGTH": Constant(CONTACT, "facets", 0.0, "contact"),
    "ELEMENT_STIFFNESS": Constant(CONTACT, "stiffnesses of the elements", 1.0, "contact"),
    "ALIKE": Constant(CONTACT, "depths of elements", 1.000001, "contact"),
    "SEAM_RATIO": Constant(CONTACT, "widths of the surface", 0.0, "contact"),
    "REACH_RATIO": Constant(CONTACT, "widths of the surface", 0.0, "contact"),
    "DEPTH_RATIO": Constant(CONTACT, "widths of the surface", 0.0, "contact"),
    "MIN_CROSS_COSINE": Constant(CONTACT, "1", 1.0, "contact"),
    "RIGID_DAMPING": Constant(CONTACT, "critical damping", 1.0, "contact"),
    "IMPACT_SPEED": Constant(CONTACT, "m/s", 0.0, "contact"),
    "IMPACT_DEPTH": Constant(CONTACT, "ways of a step", 0.0, "contact"),
    "BORDER_TOLERANCE": Constant(CONTACT, "sides of a facet", 0.0, "contact"),
    "NARROW_RATIO": Constant(CONTACT, "sides of a facet", 0.0, "contact"),
    "TALL_RATIO": Constant(CONTACT, "sides of a facet", 1.0e300, "contact"),
    "WIDEST_GAP": Constant(CONTACT, "widths", 1.0e300, "contact"),
    "SAGITTA_RATIO": Constant(CONTACT, "sizes of an element", 1.0e300, "contact"),
    "MIN_DEEP_OVERLAP_RATIO": Constant(CONTACT, "depth limit", 0.0, "contact"),
    "MIN_DEPTH_RATIO": Constant(CONTACT, "thicknesses", 0.0, "contact"),
    "EXACT_TOLERANCE": Constant(CONTACT, "1", 0.0, "contact"),
    "TOUCHING_PART_UPDATES": Constant(CONTACT, "updates", 1000000, "contact"),
    "QUADRATIC_SLOPE_RATIO": Constant(NEWTON_PCG, "slopes", 1.0e300, "contact"),
    "HARDENING": Constant(CONTACT, "1", 0.0, "contact"),
    "HARDENING_DEPTH": Constant(CONTACT, "depths of elements", 1.0e300, "contact"),
    "PASSING_DISTANCE": Constant(CONTACT, "sides of a facet", 1.0e300, "contact"),
    "UNSEEN_RATIO": Constant(CONTACT, "penetrations", 0.0, "contact"),
    "EDGE_MARGIN": Constant(CONTACT, "rad", 0.0, "contact"),
    "LEVEL_SINE": Constant(CONTACT, "1", 1.0e-6, "contact"),
    "ENTRY_DEPTH": Constant(CONTACT, "depths of elements", 0.0, "contact"),
    "BESIDE_DEPTH": Constant(CONTACT, "depths of elements", 0.0, "contact"),
    "EDGE_ENTRY_SLOPE": Constant(CONTACT, "1", 1.0e300, "contact"),
    "FACING_COSINE": Constant(CONTACT, "1", 0.0, "contact"),
}
"""Tuned constants by name, unique among the sources.

Not tuned, so without a row: MAX_NONMONOTONE and MAX_DOUBLINGS, whose absence is that of the watchdog and of doublings;
MAX_CONTACT_NOISE, the largest error that is accepted; PATCH_ANGLES, bounds of a count of points; AUTO_OVERLAP_RATIOS,
promised by `overlap`; LEVEL_COSINE, a tolerance of parallel planes; EDGE_WIDTH, that of other points at a border;
VANISHED_RESIDUAL, one of underflow; COUPLED_REBUILD_COST and MAX_COUPLED_SLOTS, costs and memory. Not needed by any row
yet: DOUBLING_RATIO (without it a falling bar takes 4 to 10 % fewer iterations) and FIRST_STEP_ERROR.
"""


def constant_file(name: str, root: pathlib.Path = ROOT) -> tuple[pathlib.Path, Any]:
    """File that defines a constant, and its value. KeyError where there is none, or several."""
    found = []
    for folder in ("kernels", "warpfea"):
        for path in sorted((root / folder).rglob("*.py")):
            for line in re.findall(rf"^(?:[A-Z_0-9]+, )*{name}(?:, [A-Z_0-9]+)* = .+$", path.read_text(), re.MULTILINE):
                names, _, values = line.partition(" = ")
                scope: dict[str, Any] = {}
                exec(f"{names} = {values}", {}, scope)
                found.append((path, scope[name]))
    if len(found) != 1:
        raise KeyError(f"{name}: {len(found)} definitions")
    return found[0]


def variants() -> dict[str, str]:
    """Labels of all variants, with their area; "" is the unchanged code."""
    return {"": ""} | dict.fromkeys(MECHANISMS, "globalisation") | {k: c.area for k, c in CONSTANTS.items()}


def disabled(variant: str, root: pathlib.Path) -> None:
    """Change the sources under `root` to a variant. KeyError where a text to replace is not there."""
    parts = [name for name in variant.split("+") if name]
    for name in CONSTANTS.keys() & {*parts}:
        path, _ = constant_file(name, root)
        path.write_text(f"{path.read_text()}\n{name} = {CONSTANTS[name].disabled!r}\n")
    for file, old, new in (change for name in parts for change in MECHANISMS.get(name, ())):
        path = root / file
        text = path.read_text()
        if old not in text:
            raise KeyError(f"{variant}: {file} has no {old!r}")
        path.write_text(text.replace(old, new))


def _tree(variant: str, folder: pathlib.Path) -> pathlib.Path:
    """A copy of the sources as a variant."""
    out = folder / str(len([*folder.iterdir()]))
    skipped = shutil.ignore_patterns("__pycache__")
    for name in COPIED:
        shutil.copytree(ROOT / name, out / name, ignore=skipped)
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, out)
    disabled(variant, out)
    return out


def _parts(labels: Mapping[str, float], count: int) -> list[list[str]]:
    """Labels in groups of about equal cost, those of a case together as they share kernels."""
    groups: dict[str, list[str]] = {}
    for label in labels:
        groups.setdefault(label.partition("/")[0], []).append(label)
    pieces = [words[k : k + 12] for words in groups.values() for k in range(0, len(words), 12)]
    pieces.sort(key=lambda piece: -math.fsum(labels[label] for label in piece))
    out: list[list[str]] = [[] for _ in range(count)]
    cost = [0.0] * count
    for piece in pieces:
        k = cost.index(min(cost))
        out[k] += piece
        cost[k] += math.fsum(labels[label] + 0.2 for label in piece)
    return [part for part in out if part]


def _child(tree: pathlib.Path, words: Sequence[str], out: pathlib.Path) -> list[Row]:
    """Rows that a command of a variant's tree writes."""
    path = [str(tree), str(ROOT / "tests"), *filter(None, [os.environ.get("PYTHONPATH")])]
    env = os.environ | {"PYTHONPATH": os.pathsep.join(path)}
    env |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONSAFEPATH": "1"}
    done = subprocess.run([sys.executable, *words], cwd=tree, env=env, capture_output=True, text=True)
    if words[1] == "pytest":
        kinds = ("PASSED", "FAILED", "ERROR")
        told = [line.split(" ", 1) for line in done.stdout.splitlines() if line.startswith(kinds)]
        return [{"case": name.split(" - ")[0], "precision": "", "passed": word == "PASSED", "outcome": word, "note": ""}
                for word, name in told]  # fmt: skip
    if not out.exists():
        return [{"case": " ".join(words[-6:]), "precision": "", "passed": False, "outcome": "crashed",
                 "note": done.stderr[-500:]}]  # fmt: skip
    found = json.loads(out.read_text())
    if words[1] == "tests.validation":
        return [row | {"case": row["label"], "precision": "float64", "passed": True} for row in found["piles"]]
    return list(found["rows"])


def _stress_rows(options: argparse.Namespace) -> dict[str, tuple[str, float]]:
    """Rows of the stress suite that are run: label -> group and seconds measured."""
    from warpfea.studies.stress.suite import load_cases, select_rows

    known = json.loads((ROOT / "tests" / "results" / "stress_cpu.json").read_text())["rows"]
    seconds = {(row["case"], row["precision"]): row["wall_s"] for row in known}
    out: dict[str, tuple[str, float]] = {}
    for row in select_rows(load_cases(), options.case, options.suite == "quick", ("float64", "float32")):
        if not row.label.startswith(LONG_ROWS):
            before = out.get(row.label, ("", 0.0))[1]
            out[row.label] = (row.case.group, before + seconds.get((row.label, row.dtype), 1.0))
    return {label: found for label, found in out.items() if found[1] <= options.longest}


def _tasks(options: argparse.Namespace, variant: str) -> Iterator[list[str]]:
    """Commands of a variant, without the file of their rows."""
    if options.rows[0] == "piles":
        yield ["-m", "tests.validation", "piles", "--device", options.device, "--rows", "pile-4", "--out"]
        return
    if options.rows[0] == "scenes":
        cases = ["--case", *options.case] if options.case else []
        yield [str(ROOT / "tests" / "scene_counts.py"), *cases, "--out"]
        return
    if options.rows[0].startswith("tests/"):
        yield ["-m", "pytest", "-q", "-rpfE", "-p", "no:cacheprovider", "-m", "", *options.rows, "--junitxml"]
        return
    if options.rows[0] == "random":
        share = -(-RANDOM_CASES // options.jobs)
        parts = [f"{k}:{min(k + share, RANDOM_CASES)}" for k in range(0, RANDOM_CASES, share)]
        for seeds in options.case or parts:
            yield [str(ROOT / "tests" / "random_cases.py"), "--device", options.device, "--seeds", seeds, "--out"]
        return
    part = CONSTANTS[variant].rows if variant in CONSTANTS else ""
    rows = {label: seconds for label, (group, seconds) in _stress_rows(options).items() if group.startswith(part)}
    quick = ["--quick"] if options.suite == "quick" else []
    for labels in _parts(rows, options.parts or options.jobs):
        cases = [word for label in labels for word in ("--case", label)]
        yield ["-m", "warpfea", "stress", "--quiet", *quick, "--device", options.device, *cases, "--json"]


def _compare(before: Sequence[Row], after: Sequence[Row]) -> Row:
    """Lost and touched rows, and the ratio of iterations over all rows that pass in both."""
    old = {(row["case"], row["precision"]): row for row in before}
    lost, touched, regained = [], set(), []
    rises: dict[str, float] = {}
    sums = {name: [0, 0] for name in ("newton", "pcg")}
    for row in after:
        was = old.get((row["case"], row["precision"]))
        name = f"{row['case']} {row['precision']}"
        if was is None:
            lost.append(f"{name}: {row.get('note', '')[:200]}")
            continue
        if any(was.get(key) != row.get(key) for key in ("newton", "pcg", "error", "outcome")):
            touched.add(row["case"])
        if was["passed"] and not row["passed"]:
            lost.append(f"{name}: {row['outcome']}: {row['note'][:160]}")
        elif row["passed"] and not was["passed"]:
            regained.append(name)
        if was["passed"] and row["passed"]:
            if isinstance(was.get("error"), list) and not same(was["error"], row["error"], row["precision"]):
                lost.append(f"{name}: another answer")
            for key, pair in sums.items():
                pair[0] += was.get(key) or 0
                pair[1] += row.get(key) or 0
            if "launches" in row:
                ratios = {key: row[key] / was[key] for key in COUNTS if was[key] >= MIN_COUNT}
                rises |= {f"{row['case']} {key}": ratio for key, ratio in ratios.items() if ratio > MIN_RISE}
    seen = {(row["case"], row["precision"]) for row in after}
    part = {case for case, _ in seen}  # of the rows before, those of other parts of the suite were not asked for
    gone = [key for key, row in old.items() if row["passed"] and key not in seen and (key[0] in part or not part)]
    lost += [f"{case} {precision}: has no answer" for case, precision in gone]
    ratio = {key: pair[1] / pair[0] if pair[0] else 1.0 for key, pair in sums.items()}
    found = {"rows": len(after), "touched": sorted(touched), "lost": lost, "regained": regained, **ratio}
    return found | ({"rises": rises} if rises else {})


def study(options: argparse.Namespace, done: Sequence[Row]) -> Iterator[Row]:
    """A row per variant that is not yet `done`."""
    of = " ".join(options.rows)
    areas, finished = variants(), {row["variant"] for row in done if row.get("of") == of}
    wanted = options.only or [*areas]
    areas |= {name: "group" for name in wanted if "+" in name}
    chosen = [name for name, area in areas.items() if name and {name, area} & {*wanted} and name not in finished]
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(options.jobs) as pool:
        folder = pathlib.Path(name)

        def submit(variant: str) -> list[Any]:
            tree = _tree(variant, folder)
            files = enumerate(_tasks(options, variant))
            return [pool.submit(_child, tree, [*words, str(out := tree / f"rows{k}.json")], out) for k, words in files]

        if options.base and options.base.exists():
            base = json.loads(options.base.read_text())
        else:
            base = [row for task in submit("") for row in task.result()]  # first: compiles what all share
        if options.base:
            options.base.write_text(json.dumps(base))
        running = {variant: submit(variant) for variant in chosen}
        for variant, tasks in running.items():
            rows = [row for task in tasks for row in task.result()]
            label: Row = {"variant": variant, "area": areas[variant], "of": of, "suite": options.suite}
            if options.case:
                label["cases"] = " ".join(options.case)
            if variant in CONSTANTS:
                constant = CONSTANTS[variant]
                value = constant_file(variant)[1]
                label |= {"value": value, "unit": constant.unit, "disabled": constant.disabled}
            yield label | _compare(base, rows)


def tables(rows: Sequence[Row]) -> str:
    """Markdown: mechanisms, then constants by area, each with its value, unit, and a row that is lost without it; last
    those that are no longer there."""
    found = [row for row in rows if row["lost"] or row["of"] in ("stress", "piles", "scenes", "random")]
    found.sort(key=lambda row: (bool(row["lost"]), "rises" in row, row["of"] != "scenes"))
    shown = {row["variant"]: row for row in found}
    gone = {*shown} - {*MECHANISMS, *CONSTANTS, *(name for name in shown if "+" in name)}
    shown |= {name: shown[name] | {"area": "removed"} for name in gone}
    out = []
    for area in sorted({row["area"] for row in shown.values()}, key=lambda name: (name in ("group", "removed"), name)):
        out += ["", f"## {area[0].upper()}{area[1:]}", ""]
        constants = area not in ("globalisation", "group")
        heads = ["name", "value", "unit", "lost without it"] if constants else ["name", "lost without it"]
        out += ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
        for name, row in shown.items():
            if row["area"] == area:
                values = [f"{row['value']:g}", row["unit"]] if constants else []
                out.append("| " + " | ".join([_shown(name), *values, reason(row)]) + " |")
    return "\n".join(out) + "\n"


def _shown(variant: str) -> str:
    """Names of a variant; of a group, those that have gone since are said."""
    names = variant.split("+")
    return ", ".join(name if len(names) == 1 or name in variants() else f"{name} (now gone)" for name in names)


def reason(row: Row) -> str:
    """The first lost row of a variant and the number of others, or the iterations or the work that it saves."""
    if row["lost"]:
        first = min(row["lost"], key=lambda text: ": missed" in text)
        case = ": ".join(first.split(": ")[:2])
        return case + (f", and {len(row['lost']) - 1} more" if len(row["lost"]) > 1 else "")
    if row.get("rises"):
        (first, ratio), more = next(iter(row["rises"].items())), len(row["rises"]) - 1
        scene, count = first.split(" ")
        return f"{scene}: {ratio:.2f} times the {COUNTS[count]}" + (f", and {more} more" if more else "")
    part = f"{row['of']} {row['cases']}: " if row.get("cases") else ""
    return f"{part}{row['newton']:.2f} times the Newton, {row['pcg']:.2f} times the PCG iterations"


def main() -> None:
    """Run the command line."""
    from warpfea.base.console import write_json
    from warpfea.base.provenance import provenance_of

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", required=True, type=pathlib.Path, help="JSON, added to where it exists")
    parser.add_argument("--only", nargs="+", default=[], help="variants, or areas of them; by default all")
    parser.add_argument(
        "--case", nargs="+", default=[], help="cases, rows or groups of the stress suite, scenes, or first:last seeds"
    )
    parser.add_argument("--suite", choices=("all", "quick"), default="all")
    parser.add_argument("--longest", type=float, default=math.inf, help="leave out rows that took more seconds")
    parser.add_argument(
        "--rows", nargs="+", default=["stress"], help="stress, random, scenes, piles, or tests of pytest by name"
    )
    parser.add_argument(
        "--base", type=pathlib.Path, help="rows of the unchanged sources: written, read where it exists"
    )
    parser.add_argument("--jobs", type=int, default=2, help="processes side by side")
    parser.add_argument(
        "--parts", type=int, default=0, help="processes per variant of the stress suite: as many as jobs"
    )
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    content = json.loads(options.out.read_text()) if options.out.exists() else {"parts": {}}
    done = [row for part in content["parts"].values() for row in part["rows"]]
    command = " ".join(["python tests/ablation.py", *sys.argv[1:]])
    part: Row = provenance_of([], options.device) | {"command": command, "rows": []}
    content["parts"][f"run {len(content['parts']) + 1}"] = part
    for row in study(options, done):
        part["rows"].append(row)
        write_json(str(options.out), content)
        shown = {key: row[key] for key in ("variant", "area", "rows", "newton", "pcg")}
        print(*shown.values(), "lost", len(row["lost"]), row["lost"][:3], flush=True)


if __name__ == "__main__":
    main()
