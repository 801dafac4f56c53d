"""Members of an object's parts as members of the object itself."""

from __future__ import annotations

from typing import Any

__all__ = ["PartMember"]


class PartMember:
    """Descriptor of a member of a part: with `positions = PartMember("results", Results.positions)` an object's
    `positions` is `results.positions`, read and written.

    Args:
        part: name of the part, an attribute of the object.
        member: function or property of the part's class, for its documentation.
    """

    def __init__(self, part: str, member: Any = None) -> None:
        self.part, self.member = part, member

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, whole: Any, owner: type) -> Any:
        return self.member if whole is None else getattr(getattr(whole, self.part), self.name)

    def __set__(self, whole: Any, value: Any) -> None:
        setattr(getattr(whole, self.part), self.name, value)
