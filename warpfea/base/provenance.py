"""Where numbers come from: versions, machine, commit."""

from __future__ import annotations

import functools
import os
import pathlib
import platform
import shlex
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

__all__ = ["commit", "machine", "origin", "versions"]


def origin(words: Sequence[str], device: Any) -> dict[str, Any]:
    """What a result file says of where its numbers come from: command, commit, machine and versions.

    Args:
        words: of the command line, without "warpfea".
        device: that was used; None for the preferred one.
    """
    return {
        "command": shlex.join(["warpfea", *words]),
        "commit": commit(),
        "machine": machine(device),
        "versions": versions(),
    }


def versions() -> dict[str, str]:
    """Versions of what made the numbers."""
    import scipy

    from .version import __version__

    return {
        "warpfea": __version__,
        "warp": wp.config.version,
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "python": platform.python_version(),
    }


def machine(device: Any) -> dict[str, Any]:
    """The computer: processor, its cores, and the device that was used."""
    used = wp.get_device(device) if device else wp.get_preferred_device()
    out = {"cpu": cpu_name(), "cores": os.cpu_count(), "system": platform.system(), "device": str(used)}
    if used.is_cuda:
        out |= {"gpu": used.name, "compute_capability": used.arch, "cuda_driver": str(wp.get_cuda_driver_version())}
    return out


def cpu_name() -> str:
    """Name of the processor."""
    if sys.platform == "linux":
        for line in pathlib.Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


@functools.cache
def commit() -> str | None:
    """Commit of the checkout that this runs from, with + if files differ; None without git or outside a checkout.

    Asked once, before results are written into the checkout.
    """
    root = pathlib.Path(__file__).resolve().parents[2]

    def ask(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, check=True).stdout.strip()

    if not (root / "pyproject.toml").is_file():  # installed: a repository around it is another's
        return os.environ.get("WARPFEA_COMMIT")
    try:
        return ask("rev-parse", "HEAD") + ("+" if ask("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.CalledProcessError):
        return os.environ.get("WARPFEA_COMMIT")  # a copy without its history is told which commit it is
