"""Writers of single files by suffix, for results that write themselves (`base.writer.writer_for`)."""

from typing import Any

from ..base.writer import register_writer
from .html import HTMLWriter
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
register_writer(_colored(HTMLWriter), ".html")
register_writer(_picture(PNGWriter), ".png")
register_writer(_picture(GIFWriter), ".gif")
register_writer(lambda path, fields, **options: VTUFile(path, **{"fields": fields} | options), ".vtu")
