"""Source checkouts, with `kernels/` and `scenes/` beside the package."""

import importlib.util
import pathlib
import sys

__all__ = ["bind_checkout_packages"]


def bind_checkout_packages(package: str) -> None:
    """Bind the two folders of a checkout as sub-packages; no effect on an installed package."""
    root = pathlib.Path(__file__).resolve().parents[2]
    if not (root / "pyproject.toml").is_file():
        return
    for name in ("kernels", "scenes"):
        init = root / name / "__init__.py"
        full = f"{package}.{name}"
        if full in sys.modules or not init.is_file():
            continue
        spec = importlib.util.spec_from_file_location(full, init, submodule_search_locations=[str(init.parent)])
        if spec is None or spec.loader is None:
            continue
        module = importlib.util.module_from_spec(spec)
        sys.modules[full] = module
        spec.loader.exec_module(module)
        setattr(sys.modules[package], name, module)
