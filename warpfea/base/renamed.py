"""Former names of members that subclasses define, refused by name: nothing would read them."""

__all__ = ["FORMER_MEMBERS", "check_members"]

FORMER_MEMBERS = {
    "Term": {
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
        "parameters_restored": "start",
        "parameters_taken": "start",
        "penalty": "Constrained",
        "preconditions": "precondition",
        "refresh": "update_frozen",
        "remark": "failure_note",
        "reserve": "allocate_blocks",
        "reserve_motions": "allocate_mode_coupling",
        "restart": "reset_scratch",
        "rewind": "shift_time",
        "take_materials": "update_materials",
        "ties": "tied_slots",
    },
    "Output": {"moments": "output_times"},
    "Material": {"own": "constant_names"},
}
"""Base class -> former name -> name."""


def check_members(kind: type, base: type) -> None:
    """TypeError where a subclass of `base` defines a member by a former name."""
    for old, new in FORMER_MEMBERS[base.__name__].items():
        if old in vars(kind) and not hasattr(base, old):
            raise TypeError(f"{kind.__qualname__}.{old}: this member of {base.__name__} is called {new!r} now")
