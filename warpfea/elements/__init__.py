"""Element families as tables. A new family is a file here that calls `register` and is imported below."""

from . import ancf_beam, ancf_shell, ancf_solid, lagrange, rigid
from .family import EnergyPart, Family, families, family_for_cell, get_family, register
from .quadrature import TET_RULES, Rule

__all__ = [
    "TET_RULES", "EnergyPart", "Family", "Rule", "ancf_beam", "ancf_shell", "ancf_solid", "families", "family_for_cell",
    "get_family", "lagrange", "register", "rigid",
]  # fmt: skip
