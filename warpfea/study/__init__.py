"""Studies of error against run time: each repeats a comparison and gives a table, JSON, CSV and a plot."""

from .report import Row, Study
from .tets import ancf_tets

__all__ = ["Row", "Study", "ancf_tets"]
