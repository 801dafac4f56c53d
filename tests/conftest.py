"""What the tests share: a quiet Warp, the reference data, the skipping of CUDA tests."""

from __future__ import annotations

import functools
import json
import types
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import warpfea as wf

DATA = Path(__file__).parent / "data"

wp.config.log_level = 30  # warnings and errors: no greeting, no lines for loaded modules


@functools.cache
def _reference(name):
    return json.loads((DATA / f"{name}.json").read_text())


@functools.cache
def _mesh(name):
    return wf.mesh.read(DATA / f"{name}.msh")


def pytest_collection_modifyitems(items):
    marked = [item for item in items if "cuda" in item.keywords]
    if marked and not wp.is_cuda_available():
        for item in marked:
            item.add_marker(pytest.mark.skip(reason="no CUDA device"))


@pytest.fixture(scope="session", autouse=True)
def _double_precision_printing():
    """Failures show enough digits to tell round-off from a defect."""
    with np.printoptions(precision=12):
        yield


@pytest.fixture(scope="session")
def device():
    """The device of tests that do not say otherwise."""
    return "cpu"


@pytest.fixture(scope="session")
def data():
    """Reference results by file name, meshes by file name, and the errors that tests measure with."""

    def error(value, expected, scale=None):
        """Largest difference over `scale`, by default the largest expected value."""
        value, expected = np.asarray(value, dtype=float), np.asarray(expected, dtype=float)
        scale = np.abs(expected).max() if scale is None else scale
        return float(np.abs(value - expected).max() / scale)

    return types.SimpleNamespace(path=DATA, json=_reference, mesh=_mesh, error=error)
