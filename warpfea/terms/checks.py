"""Validate terms before launch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import ModelError
from ..kernels.common.traits import Traits
from ..kernels.step.energy_ledger import EXPLICIT_VISCOUS, LEDGER_COLUMNS, LOSS, NUMERICAL, STORED, WORK
from .protocols import PROTOCOLS, Constrained, Impacting, Updated
from .term import Term

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = [
    "check_constructed",
    "check_energy_increments",
    "check_ledger_columns",
    "check_stored_columns",
    "check_stored_energy",
    "check_tables",
    "check_unique_names",
    "derived_traits",
    "overrides",
    "stored_columns",
]

COLUMN_KINDS = {
    STORED: "STORED",
    WORK: "WORK",
    LOSS: "LOSS",
    NUMERICAL: "NUMERICAL",
    EXPLICIT_VISCOUS: "EXPLICIT_VISCOUS",
}
RESERVED_ENERGY_KEYS = ("work",)
"""Keys of energies() reserved for sums of columns."""


def check_constructed(term: Any, make: Any, model: Model) -> None:
    """Raise ModelError unless the function given to add_term returned a named term of this model."""
    if not isinstance(term, Term):
        raise ModelError(f"add_term: {make!r} returned {term!r}; expected a warpfea.terms.Term, or None")
    if not isinstance(getattr(term, "name", None), str) or not term.name:
        raise ModelError(f"term {type(term).__name__}: `name` must be a non-empty string, such as name = 'contact'")
    if not hasattr(term, "connectivity"):
        raise ModelError(f"term {term.name!r}: its __init__ must call super().__init__(model)")
    if term.model is not model:
        raise ModelError(f"term {term.name!r} was made for another model: make one in the function given to add_term")
    kind = type(term)
    for protocol in (protocol for protocol in PROTOCOLS if not isinstance(term, protocol)):
        for method in (name for name in vars(protocol) if not name.startswith("_") and hasattr(kind, name)):
            raise ModelError(
                f"term {term.name!r}: {method} is a method of {protocol.__name__}, see warpfea.terms.protocols: derive "
                f"{kind.__name__} from it"
            )


def check_unique_names(terms: Sequence[Term], taken: Sequence[str], what: str, names: Any) -> None:
    """Raise ModelError for a duplicate or reserved name; `names(term)`: dict of name and specification.

    Two terms may share a field whose specification says how their values are merged (`join`).
    """
    owner: dict[str, Term] = {}
    for term in terms:
        for name in names(term):
            if name in taken:
                raise ModelError(f"term {term.name!r}: {what} {name!r} is taken; give it a name of its own")
            shared = name in owner and names(owner[name])[name]
            if name in owner and not (names(term)[name] is shared and getattr(shared, "join", None)):
                raise ModelError(f"terms {owner[name].name!r} and {term.name!r} both have {what} {name!r}")
            owner[name] = term


def overrides(term: Term, method: Any) -> bool:
    """True if a term overrides a method of Term or of a protocol, in its class or by itself."""
    return method.__name__ in vars(term) or getattr(type(term), method.__name__, method) is not method


def derived_traits(term: Term) -> Traits:
    """Traits of a term, from its tables, protocols and overridden methods."""
    entries, constrained = any(conn.size for conn in term.connectivity), isinstance(term, Constrained)
    return Traits(
        pooled=entries and term.potential,
        nonpotential=entries and not term.potential,
        tangent=entries and not term.potential and overrides(term, Term.product),
        stored=term.rows > 0,
        constraint_rows=constrained,
        has_constraints=constrained,
        limited=overrides(term, Updated.process_direction),
        unilateral=overrides(term, Updated.update_frozen),
        impacts=isinstance(term, Impacting) and term.impacts,
        plastic=isinstance(term, Impacting) and term.plastic,
    )


def check_tables(term: Term, model: Model) -> None:
    """Raise ModelError unless connectivity and rows of a built term are valid."""
    for k, conn in enumerate(_connectivity_arrays(term)):
        where = f"term {term.name!r}, connectivity[{k}]"
        if not (isinstance(conn, np.ndarray) and conn.ndim == 2 and np.issubdtype(conn.dtype, np.integer)):
            found = f"{conn.dtype}{list(conn.shape)}" if isinstance(conn, np.ndarray) else repr(conn)
            raise ModelError(f"{where}: expected an array of ints (items, slots of an item), got {found}")
        if conn.size and not (conn.min() >= 0 and conn.max() < model.slots):
            raise ModelError(f"{where}: slots {conn.min()} to {conn.max()} are not within 0 to {model.slots - 1}")
    for name in ("rows", "report_columns", "increment_rows"):
        value = getattr(term, name)
        if not isinstance(value, (int, np.integer)) or value < 0:
            raise ModelError(f"term {term.name!r}: {name} = {value!r} must be a whole number, 0 or more")
    if term.rows and not term.connectivity and not isinstance(term, Constrained):
        raise ModelError(f"term {term.name!r} has rows of a potential, but it sets no connectivity")
    if hasattr(term, "traits"):
        raise ModelError(f"term {term.name!r} sets traits: they follow from its tables, protocols and methods")


def _connectivity_arrays(term: Term) -> Sequence[Any]:
    if not isinstance(term.connectivity, (list, tuple)):
        raise ModelError(f"term {term.name!r}: connectivity must be a list of arrays, got {term.connectivity!r}")
    return term.connectivity


def check_stored_columns(terms: Sequence[Term]) -> None:
    """Raise ModelError for a column of stored energy of two terms: it holds a current value, J, not an increment."""
    every = [(column.name, term.name) for term in terms for column in term.columns if column.name]
    for name in (name for term in terms for name in stored_columns(term)):
        owners = [owner for other, owner in every if other == name]
        if len(owners) > 1:
            raise ModelError(
                f"energy column {name!r} stores energy and is shared by {owners[0]!r} and {owners[1]!r}: rename one"
            )


def stored_columns(term: Term) -> list[str]:
    """Names of the columns of stored energy."""
    return [column.name for column in term.columns if column.kind == STORED]


def check_ledger_columns(term: Term, *, own: bool) -> None:
    """Raise ModelError unless a term's ledger columns are valid; `own`: a built-in term."""
    if term.columns and not overrides(term, Term.energy_increments):
        raise ModelError(f"term {term.name!r} has columns, but does not override energy_increments")
    for column in term.columns:
        where = f"term {term.name!r}, column {column.name!r}"
        if column.kind not in COLUMN_KINDS:
            raise ModelError(f"{where}: kind {column.kind!r} is none of {', '.join(COLUMN_KINDS.values())}")
        if column.kind in (STORED, WORK, LOSS) and not column.name:
            raise ModelError(f"{where}: {COLUMN_KINDS[column.kind]} needs a name, the column of energies()")
        if column.kind == STORED and not overrides(term, Term.stored_energy):
            raise ModelError(f"{where}: override stored_energy: the ledger restarts from its value after a reset")
        if own:
            continue
        if column.kind == EXPLICIT_VISCOUS:
            raise ModelError(f"{where}: EXPLICIT_VISCOUS is reserved for explicit damping terms of warpfea")
        if column.name in (*LEDGER_COLUMNS, *RESERVED_ENERGY_KEYS):
            raise ModelError(f"{where}: the ledger has a column of its own by this name")
        if column.kind == WORK and not column.name.startswith("work_"):
            raise ModelError(f"{where}: name columns of work work_..., they count in energies()['work']")
        if column.name.startswith("work_") and column.kind != WORK:
            raise ModelError(f"{where}: columns named work_... count in energies()['work'], this one is no work")


def check_stored_energy(term: Term, values: Any, worlds: int) -> None:
    """Raise ModelError unless `stored_energy` returned all columns of stored energy."""
    if not isinstance(values, dict) or set(values) != set(stored_columns(term)):
        values = values if isinstance(values, dict) else [repr(values)]
        raise ModelError(
            f"term {term.name!r}: stored_energy gave {sorted(values)}; its columns of stored energy are "
            f"{stored_columns(term)}"
        )
    for name, amounts in values.items():
        if np.shape(amounts) != (worlds,):
            raise ModelError(
                f"term {term.name!r}: stored_energy gave {np.shape(amounts)} for {name!r}; expected ({worlds},)"
            )


def check_energy_increments(term: Term, rows: Any, worlds: int, max_items: int) -> None:
    """Raise ModelError unless `energy_increments` returned rows (columns, worlds, items) in float64."""
    import warp as wp

    where = f"term {term.name!r}: energy_increments returned"
    if not isinstance(rows, wp.array):
        raise ModelError(f"{where} {type(rows).__name__}; expected a warp array or None")
    count = len(term.columns)
    if rows.ndim != 3 or rows.dtype != wp.float64 or rows.shape[0] < count or rows.shape[1] != worlds:
        raise ModelError(
            f"{where} {rows.dtype.__name__}{list(rows.shape)}; expected float64[at least {count}, {worlds}, items]: a "
            "row per column and world"
        )
    if rows.shape[2] > max_items:
        raise ModelError(
            f"{where} {rows.shape[2]} items a row; at most {max_items} can be summed unless build sets increment_rows"
        )
