"""Representations for notebooks: tables of names and texts, and pages in frames."""

import html
import pathlib
import tempfile
from collections.abc import Mapping
from typing import Any

from .writer import writer_for

__all__ = ["drawn_page", "page_frame", "summary_table"]

FRAME_HEIGHT = 720
"""Height of a page in a notebook, pixels."""


def summary_table(title: str, rows: Mapping[str, Any]) -> str:
    """HTML table of names and texts; empty texts are left out."""
    cells = "".join(
        f"<tr><th style='text-align:left'>{html.escape(name)}</th>"
        f"<td style='text-align:left'>{html.escape(str(text))}</td></tr>"
        for name, text in rows.items()
        if text not in ("", None, [], {})
    )
    return f"<table><caption style='text-align:left'>{html.escape(title)}</caption>{cells}</table>"


def page_frame(text: str) -> str:
    """A whole page in a frame, without a file beside the notebook."""
    style = f"width:100%;height:{FRAME_HEIGHT}px;border:0"
    return f'<iframe srcdoc="{html.escape(text)}" sandbox="allow-scripts" style="{style}"></iframe>'


def drawn_page(sim: Any, fields: list[str]) -> str:
    """Frame with the page of the present state of a simulation."""
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "page.html"
        writer = writer_for(path, fields)
        writer.open(sim)
        writer.close(sim)
        return page_frame(path.read_text("utf-8"))
