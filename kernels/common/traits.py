"""What the terms of a model ask of the kernels of a step, which are specialised by it: absent terms cost nothing."""

from typing import NamedTuple

__all__ = ["NO_TERMS", "Traits"]


class Traits(NamedTuple):
    """What is there besides the elements.

    Attributes:
        nonpotential: forces without a potential; Phi holds those of the last iterate in a line search.
        tangent: such forces have a symmetric tangent that counts in H.
        pooled: terms with a potential that contribute to slots by the pool of terms.
        ties: constraints, whose rows are gathered with the slots.
        stored: terms have a potential of their own, in rows that are summed per world.
        gated: constraints whose violation must fall below a tolerance, and whose multipliers change with the iterate.
        limited: terms may shorten a Newton step.
        walls: terms have forces that set in suddenly, such as contact.
        midpoint: of the integrator: forces are those of the middle of a step and have no potential by its end.
    """

    nonpotential: bool = False
    tangent: bool = False
    pooled: bool = False
    ties: bool = False
    stored: bool = False
    gated: bool = False
    limited: bool = False
    walls: bool = False
    midpoint: bool = False

    def suffix(self, *names: str) -> str:
        """Part of a module's name that tells the traits in `names` that are there."""
        return "".join(f"_{name}" for name in names if getattr(self, name))


NO_TERMS = Traits()
