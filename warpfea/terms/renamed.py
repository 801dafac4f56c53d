"""Former names of the methods of a term, refused in subclasses: a method of that name would never be called."""

from __future__ import annotations

__all__ = ["FORMER_MEMBERS", "check_methods"]

FORMER_MEMBERS = {
    "adopt": "accept_trial",
    "aim": "process_direction",
    "book": "energy_increments",
    "booked_rows": "increment_rows",
    "carry": "copy_cached",
    "couple": "add_mode_coupling",
    "couples": "coupled_bodies",
    "explain": "failure_reason",
    "follow": "prepare_solve",
    "hold": "mark_constrained",
    "keep": "cached_inputs",
    "measure": "stored_energy",
    "outer": "update_multipliers",
    "parameters_taken": "parameters_restored",
    "refresh": "update_frozen",
    "remark": "failure_note",
    "reserve": "allocate_blocks",
    "reserve_motions": "allocate_mode_coupling",
    "restart": "reset_scratch",
    "rewind": "shift_time",
    "take_materials": "update_materials",
    "ties": "tied_slots",
}
"""Former name -> name."""


def check_methods(kind: type, base: type) -> None:
    """TypeError where a subclass of `base` defines a member by a former name."""
    for name in vars(kind):
        if name in FORMER_MEMBERS and not hasattr(base, name):
            raise TypeError(f"{kind.__qualname__}.{name}: this member of a Term is called {FORMER_MEMBERS[name]!r} now")
