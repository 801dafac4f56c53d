"""What all pictures need."""

from __future__ import annotations

from typing import Any

from ..base.errors import OutputError

__all__ = ["require_matplotlib"]


def require_matplotlib() -> Any:
    """matplotlib's Figure class. OutputError where it is not installed."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise OutputError(f"the plot needs matplotlib: pip install 'warpfea[plots]' ({error})") from error
    return Figure
