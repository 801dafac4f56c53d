"""Suggestions for misspelled names."""

import difflib
from collections.abc import Collection, Iterable
from typing import Any

from .errors import ModelError

__all__ = ["check_choice", "check_known", "did_you_mean", "listing"]

SIMILARITY_CUTOFF = 0.6
"""Similarity, 0 to 1, from which a known name is suggested."""
MAX_SHORT_LENGTH, SHORT_CUTOFF = 5, 0.75
"""Maximum length of a short name, and its similarity cutoff: one common letter is weaker evidence."""

SYNONYMS = {
    "rho": "density",
    **dict.fromkeys(("young", "youngs_modulus", "modulus"), "E"),
    **dict.fromkeys(("poisson", "poissons_ratio"), "nu"),
    **dict.fromkeys(("hinge", "pin"), "revolute"),
    **dict.fromkeys(("ball", "socket"), "spherical"),
    **dict.fromkeys(("prismatic", "slider"), "translational"),
    **dict.fromkeys(("mises", "stress"), "von_mises"),
    **dict.fromkeys(("newmark", "hht"), "generalized_alpha"),
    **dict.fromkeys(("euler", "implicit_euler"), "backward_euler"),
}
"""Synonyms of names used here."""


def did_you_mean(name: object, known: Iterable[object]) -> str:
    """The text "; did you mean 'x'?" with the known name closest to `name`, or "" if none is close.

    Case, hyphens for underscores and leading hyphens are ignored. A short name also matches a permutation of its
    letters, and synonyms (`SYNONYMS`) match their name.
    """
    wanted = _normalise(str(name))
    plain: dict[str, str] = {}
    for text in map(str, known):
        plain.setdefault(_normalise(text), text)
    if SYNONYMS.get(wanted) in plain.values():
        return f"; did you mean {SYNONYMS[wanted]!r}?"
    found = difflib.get_close_matches(
        wanted, plain, n=1, cutoff=SHORT_CUTOFF if len(wanted) <= MAX_SHORT_LENGTH else SIMILARITY_CUTOFF
    )
    found = found or [text for text in plain if sorted(text) == sorted(wanted)]
    return f"; did you mean {plain[found[0]]!r}?" if found else ""


def check_known(what: str, name: Any, known: Collection[Any]) -> None:
    """ModelError for a name that is not among the known ones, which it lists; `what`: its kind."""
    if name not in list(known):  # a name that can't be hashed, too
        raise ModelError(f"{what} {name!r} is unknown; there are {', '.join(known)}{did_you_mean(name, known)}")


def check_choice(name: str, value: Any, known: Collection[Any]) -> None:
    """ModelError for a value of `name` that is not among the known ones."""
    if value not in known:
        raise ModelError(f"{name} = {value!r} is none of {', '.join(map(repr, known))}{did_you_mean(value, known)}")


def listing(known: Iterable[object]) -> str:
    """Quoted names separated by commas, or "none"."""
    return ", ".join(repr(str(name)) for name in known) or "none"


def _normalise(text: str) -> str:
    return text.casefold().lstrip("-").replace("-", "_")
