"""Commands that only made files of tests/results: tables of `python -m tests.validation` now."""

from __future__ import annotations

from collections.abc import Sequence

from ..base.errors import UsageError

__all__ = ["MOVED", "refuse_moved"]

MOVED = {
    ("bench", "--growth"): "growth",
    ("bench", "--product"): "product",
    ("bench", "--cpu"): "cpu",
    ("bench", "--scenes"): "scene_costs",
    ("bench", "--contact"): "contact_cost",
    ("bench", "--price"): "price",
    ("bench", "--pairs"): "pair_cost",
    ("study", "ancf-tets"): "ancf_tets",
    ("study", "peer-meshes"): "peer_meshes",
}
"""Command and word -> table."""


def refuse_moved(words: Sequence[str]) -> None:
    """Refuse a command that has become a table, and name the table. UsageError."""
    for word in words[1:]:
        table = MOVED.get((words[0], word))
        if table is not None:
            raise UsageError(
                f"{words[0]} {word}: is the table {table!r} now: python -m tests.validation {table} (from the root of "
                "a checkout; --help tells its options)"
            )
