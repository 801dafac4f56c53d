"""Shared by the tests: a quiet Warp, the reference data, the skipping of CUDA tests."""

from __future__ import annotations

import functools
import gc
import json
import os
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from warp._src.apic.capture import APICapture
from warp._src.codegen import Struct

import warpfea as wf

DATA = Path(__file__).parent / "data"

sys.dont_write_bytecode = False  # processes of tests would translate the package anew, a third of their start
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
wp.config.log_level = 30  # warnings and errors: no greeting, no lines for loaded modules
gc.set_threshold(100_000, 20, 50)  # a worker holds the syntax trees of all kernels, which each collection goes through


def remember_launches():
    """Make Warp's recorder of CPU graphs describe a struct, and a launch, once in a capture.

    A step passes the same few structs, of some forty arrays each, to nearly every launch, and evaluates its forces in
    several branches: the descriptions, in Python, are half of what a short test takes. They follow from the bytes of
    the arguments, which hold their pointers. Returns a function that undoes it.
    """
    walk, describe = APICapture._walk_value_pointers, APICapture.build_launch_info

    def walk_value_pointers(self, arg_type, original, packed, base, out):
        if base != 0 or not isinstance(arg_type, Struct):
            return walk(self, arg_type, original, packed, base, out)
        known = self.__dict__.setdefault("known_structs", {})
        key = arg_type, bytes(packed)
        if key not in known:
            known[key] = []
            walk(self, arg_type, original, packed, base, known[key])
        out.extend(known[key])
        return None

    def build_launch_info(self, kernel, module_exec, hooks, params, fwd_args, adjoint, adj_args=None):
        known = self.__dict__.setdefault("known_launches", {})
        key = kernel, adjoint, *(bytes(param) for param in params[1:])
        if key not in known:
            info = describe(self, kernel, module_exec, hooks, params, fwd_args, adjoint, adj_args)
            known[key] = info, self._last_value_data, self._last_param_array, self._last_relocs
        return known[key][0]

    APICapture._walk_value_pointers, APICapture.build_launch_info = walk_value_pointers, build_launch_info

    def undo():
        APICapture._walk_value_pointers, APICapture.build_launch_info = walk, describe

    return undo


remember_launches()


@functools.cache
def _reference(name):
    return json.loads((DATA / f"{name}.json").read_text())


@functools.cache
def _mesh(name):
    return wf.mesh.read(DATA / f"{name}.msh")


COSTLY = set((Path(__file__).parent / "data/slow.txt").read_text().splitlines())
"""Tests with kernel modules or steps of their own, most CPU time first until the rest met its limit: slow, too."""


PROCESSES = {"test_sweep_study.py", "test_sweep.py", "test_torch.py"}
"""Files whose slow tests take longest and wait for processes: first, so that no core is idle at the end."""


def pytest_collection_modifyitems(items):
    items.sort(key=lambda item: item.path.name not in PROCESSES)
    for item in items:
        if item.nodeid in COSTLY:
            item.add_marker(pytest.mark.slow)
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
