"""Packages that are imported on first use, so that `import warpfea` is light."""

import importlib
from typing import Any

from .errors import OutputError

__all__ = ["LazyPackage", "meshio", "pillow", "pxr", "require_matplotlib"]


class LazyPackage:
    """Package of which a member or a module is imported where it is read as an attribute."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # of protocols, such as pickle's, that look for it
            raise AttributeError(name)
        package = importlib.import_module(self._name)
        return getattr(package, name) if hasattr(package, name) else importlib.import_module(f"{self._name}.{name}")


meshio, pillow, pxr = LazyPackage("meshio"), LazyPackage("PIL"), LazyPackage("pxr")


def require_matplotlib() -> Any:
    """matplotlib's Figure class. OutputError where it is not installed."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise OutputError(f"the plot needs matplotlib: pip install 'warpfea[plots]' ({error})") from error
    return Figure
