"""Element families as tables. Adding one is a file that calls `register`."""

from . import lagrange
from .family import Family, families, for_cell, get, register
from .quadrature import TET_RULES, Rule

__all__ = ["TET_RULES", "Family", "Rule", "families", "for_cell", "get", "lagrange", "register"]
