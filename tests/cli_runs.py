"""Calls of the command line in this process."""

from __future__ import annotations

import mesh_writers as writers

import warpfea as wf
from warpfea.cli import main

SHORT = ["run", "cantilever", "--device", "cpu", "--set", "cells=2", "--dt", "0.002", "--t-end", "0.01"]
SVK = "svk:E=1e7,nu=0.3,density=1000"
SCENES = """
import warpfea as wf

def bar(force):
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_solid(wf.mesh.box((1, .2, .2), cells=(2, 1, 1)), material=wf.SVK(E=1e7, nu=.3, density=1000))
    b.clamp(body.nodes("x-"))
    loads = [(0, 0, 0), (0, 0, -100), (0, 0, -100 - force), (0, 0, -100 - force)]
    b.add_traction(body.surface("x+"), ([0, .01, .02, .03], loads))
    b.add_probe("tip", body.surface("x+"))
    return b

@wf.scene(dt=2e-3, t_end=.02)
def good(*, force: float = 0.0) -> wf.ModelBuilder:
    '''A bar that is bent.'''
    return bar(force)

@wf.scene(dt=2e-3, t_end=.03)
def bursts() -> wf.ModelBuilder:
    '''A bar that is crushed by an absurd force.'''
    return bar(1e30)

@wf.scene(dt=2e-3, t_end=.02)
def broken(*, count: int = 0) -> wf.ModelBuilder:
    '''An error in the scene itself.'''
    return [bar(0.0)][1]

@wf.scene(dt=2e-3, t_end=.02)
def later() -> wf.ModelBuilder:
    '''Wants what this version lacks.'''
    b = wf.ModelBuilder()
    b.add_beam([(0, 0, 0), (1, 0, 0)])
    return b
"""


def working_folder(tmp_path, monkeypatch):
    """A working folder with a mesh, a file of scenes, and things that are neither."""
    mesh = wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1))
    writers.write(writers.Parts.of(mesh), tmp_path / "part.msh", "msh22")
    (tmp_path / "mine.py").write_text(SCENES)
    (tmp_path / "empty.py").write_text("x = 1\n")
    (tmp_path / "bad.msh").write_text("no mesh at all\n")
    (tmp_path / "bad.npz").write_text("no checkpoint\n")
    (tmp_path / "bad.usdc").write_text("no stage\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def files(folder):
    return {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file() and "__pycache__" not in p.parts}


def run(capfd, *words):
    """Exit code, stdout and stderr of a command."""
    capfd.readouterr()
    code = main([str(word) for word in words])
    out, err = capfd.readouterr()
    return code, out, err
