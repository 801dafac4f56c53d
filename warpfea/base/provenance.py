"""Provenance of results: versions, machine, commit."""

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

__all__ = ["git_commit", "machine", "provenance_of", "versions"]


def provenance_of(words: Sequence[str], device: Any) -> dict[str, Any]:
    """Provenance of a result file: command, commit, machine and versions.

    Args:
        words: words of the command line, without "warpfea".
        device: device used; None for the preferred one.
    """
    return {
        "command": shlex.join(["warpfea", *words]),
        "commit": git_commit(),
        "machine": machine(device),
        "versions": versions(),
    }


def versions() -> dict[str, str]:
    """Versions of the software."""
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
    """The computer: processor, cores and device used."""
    used = wp.get_device(device) if device else wp.get_preferred_device()
    out = {"cpu": cpu_name(), "cores": os.cpu_count(), "system": platform.system(), "device": str(used)}
    if used.is_cuda:
        out |= {"gpu": used.name, "compute_capability": used.arch, "cuda_driver": str(wp.get_cuda_driver_version())}
    return out


def cpu_name() -> str:
    """Processor name."""
    if sys.platform == "linux":
        for line in pathlib.Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


@functools.cache
def git_commit() -> str | None:
    """Commit of this checkout, with + if files differ; None without git or outside a checkout.

    Evaluated once, before results are written into the checkout.
    """
    root = pathlib.Path(__file__).resolve().parents[2]

    def run_git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, check=True).stdout.strip()

    if not (root / "pyproject.toml").is_file():  # installed: a surrounding repository is unrelated
        return os.environ.get("WARPFEA_COMMIT")
    try:
        return run_git("rev-parse", "HEAD") + ("+" if run_git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.CalledProcessError):
        return os.environ.get("WARPFEA_COMMIT")  # the commit is passed to a copy without history
