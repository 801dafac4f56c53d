"""Commands that only made files of tests/results: tables of `python -m tests.validation` now."""

from __future__ import annotations

from collections.abc import Sequence

from ..base.errors import UsageError

__all__ = ["MOVED", "refuse_moved"]

STUDIES = (
    "adaptive", "ancf", "ancf-tets", "conservation", "contact", "contact-integrators", "devices", "floor", "joints",
    "mechanisms", "peer-meshes", "precision", "spinning",
)  # fmt: skip
KINDS = {"growth": "growth", "product": "product", "cpu": "cpu", "scenes": "scene_costs", "contact": "contact_cost",
         "price": "price", "pairs": "pair_cost"}  # fmt: skip
MOVED = {("study", name): name.replace("-", "_") for name in STUDIES}
MOVED |= {("bench", f"--{kind}"): table for kind, table in KINDS.items()}
"""Command and word -> table."""


def refuse_moved(words: Sequence[str]) -> None:
    """Refuse a command that has become a table, and name the table. UsageError."""
    for word in words[1:2] if words[:1] == ["study"] else words[1:]:
        table = MOVED.get((words[0], word))
        if table is not None:
            raise UsageError(
                f"{words[0]} {word}: is the table {table!r} now: python -m tests.validation {table} (from the root of "
                "a checkout; --help tells its options)"
            )
