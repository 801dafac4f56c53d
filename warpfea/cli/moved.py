"""Commands that only made files of tests/results: tables of `python -m tests.validation` now, or no longer kept."""

from collections.abc import Sequence

from ..base.errors import UsageError

__all__ = ["MOVED", "refuse_moved"]

MOVED_STUDIES = (
    "ancf", "conservation", "contact", "contact-integrators", "devices", "floor", "joints", "mechanisms", "precision",
    "spinning",
)  # fmt: skip
MOVED_BENCH_KINDS = {"cpu": "cpu", "scenes": "scene_costs", "contact": "contact_cost", "price": "price"}
MOVED: dict[tuple[str, str], str | None] = {("study", name): name.replace("-", "_") for name in MOVED_STUDIES}
MOVED |= {("bench", f"--{kind}"): table for kind, table in MOVED_BENCH_KINDS.items()}
MOVED |= {("study", name): None for name in ("adaptive", "ancf-tets", "peer-meshes")}
MOVED |= {("bench", f"--{kind}"): None for kind in ("growth", "pairs", "product")}
"""Command and word -> table; None: none makes its files today."""


def refuse_moved(words: Sequence[str]) -> None:
    """Refuse a command that is a table now, whose name the error tells, or that is no longer kept. UsageError."""
    for word in words[1:2] if words[:1] == ["study"] else words[1:]:
        if (words[0], word) not in MOVED:
            continue
        table = MOVED[words[0], word]
        if table is None:
            raise UsageError(f"{words[0]} {word}: is gone after commit 51a4e5d; its files of tests/results stay")
        raise UsageError(
            f"{words[0]} {word}: is the table {table!r} now: python -m tests.validation {table} (from the root of "
            "a checkout; --help tells its options)"
        )
