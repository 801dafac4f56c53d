"""Traits of a model's terms that specialise the kernels of a step: absent terms cost nothing."""

from typing import Any, NamedTuple

__all__ = ["NO_TERMS", "Traits"]


class Traits(NamedTuple):
    """Terms present besides the elements, derived by warpfea/terms/checks.py from what each term is and does.

    Attributes:
        nonpotential: non-conservative forces; Phi freezes those of the last iterate in a line search.
        tangent: such forces have a symmetric tangent in H.
        pooled: terms with a potential that contribute to slots through the pool of terms.
        constraint_rows: constraints, whose rows are gathered with the slots.
        stored: terms have stored energy, in rows that are summed per world.
        has_constraints: constraints with a violation tolerance, and with multipliers that change with the iterate.
        limited: terms may shorten a Newton step.
        unilateral: terms have unilateral forces, such as contact.
        impacts: terms may stop a body within a step.
        plastic: such impacts may leave no speed, of which mid-point schemes are no model.
        midpoint: of the integrator: forces are those at the midpoint of a step and have no potential in its end state.
    """

    nonpotential: bool = False
    tangent: bool = False
    pooled: bool = False
    constraint_rows: bool = False
    stored: bool = False
    has_constraints: bool = False
    limited: bool = False
    unilateral: bool = False
    impacts: bool = False
    plastic: bool = False
    midpoint: bool = False

    def takes_again(self, scheme: Any) -> bool:
        """True if attempts of an integrator that do not resolve an impact are taken again by backward Euler."""
        return (self.impacts and (scheme.multistep or scheme.accelerated)) or (self.plastic and scheme.midpoint)

    def suffix(self, *names: str) -> str:
        """Module name suffix of those traits in `names` that are set."""
        return "".join(f"_{name}" for name in names if getattr(self, name))


NO_TERMS = Traits()
