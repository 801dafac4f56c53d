"""Writers of single files by suffix, for results that write themselves (`base.writer.writer_for`)."""

from typing import Any

import numpy as np

from ..base.writer import VIEWERS, register_writer, writer_for
from ..simulation.results import Results
from .html import HTMLWriter
from .markers import KINDS
from .render import GIFWriter, PNGWriter
from .usd import SUFFIXES, USDWriter
from .vtk import VTUFile

__all__: list[str] = []


def _colored(kind: Any) -> Any:
    return lambda path, fields, **options: kind(
        path, **{"fields": fields, "color": fields[0] if fields else None} | options
    )


def _picture(kind: Any) -> Any:
    return lambda path, fields, **options: kind(path, **{"field": fields[0] if fields else None} | options)


register_writer(_colored(USDWriter), *SUFFIXES)
register_writer(_colored(HTMLWriter), ".html", ".htm")
register_writer(_picture(PNGWriter), ".png")
register_writer(_picture(GIFWriter), ".gif")
register_writer(lambda path, fields, **options: VTUFile(path, **{"fields": fields} | options), ".vtu")


def _show(model: Any, path: Any, **options: Any) -> None:
    """Write a model at its initial state; pictures with all marks, names and axes."""
    at_start: Any = Results(model, model.state())
    at_start.time = np.zeros(model.worlds)
    drawn = {"marks": KINDS, "axes": True, "legend": True} if str(path).lower().endswith((".png", ".gif")) else {}
    writer = writer_for(path, [], **drawn | options)
    writer.open(at_start)
    writer.close(at_start)


VIEWERS.append(_show)
