"""Studies of error against run time: each repeats a comparison and gives a table, JSON, CSV and a plot."""

from .comparison import ancf_tets
from .report import Row, Study

__all__ = ["Row", "Study", "ancf_tets"]
