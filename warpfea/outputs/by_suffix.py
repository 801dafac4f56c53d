"""Writers of single files by suffix, for results that write themselves (`base.writer.writer_for`)."""

from collections.abc import Sequence
from typing import Any

from ..base.writer import register_writer
from .render import GIFWriter, PNGWriter
from .usd import SUFFIXES, USDWriter

__all__: list[str] = []


def _usd(path: Any, fields: Sequence[str], **options: Any) -> USDWriter:
    return USDWriter(path, **{"fields": fields, "color": fields[0] if fields else None} | options)


def _picture(kind: Any) -> Any:
    return lambda path, fields, **options: kind(path, **{"field": fields[0] if fields else None} | options)


register_writer(_usd, *SUFFIXES)
register_writer(_picture(PNGWriter), ".png")
register_writer(_picture(GIFWriter), ".gif")
