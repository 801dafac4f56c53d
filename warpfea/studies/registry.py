"""The studies that `warpfea study` knows: one line here, one module with `run(options)`, one committed result."""

from __future__ import annotations

import argparse
import importlib
from dataclasses import dataclass

__all__ = ["STUDIES", "Entry"]


@dataclass(frozen=True)
class Entry:
    """A study, described without importing it.

    Attributes:
        name: as users type it.
        module: below warpfea.studies, with a function `run(options)`.
        summary: a line for the list of studies.
        about: what it does, for its own help.
        parts: names for --only, each with a line of help.
        options: those it takes besides --out, of `cli.measuring.STUDY_OPTIONS`.
        out: what --out names, "FILE" (.json) or "FOLDER"; empty where nothing is written.
        example: a command line, after the name.
        takes: how long it takes on two cores.
        results: files of tests/results that it made.
    """

    name: str
    module: str
    summary: str
    about: str
    parts: tuple[tuple[str, str], ...] = ()
    options: tuple[str, ...] = ()
    out: str = "FILE"
    example: str = ""
    takes: str = "minutes"
    results: tuple[str, ...] = ()

    def run(self, options: argparse.Namespace) -> None:
        """Do the study. UsageError for what it can't do, other errors of warpfea from its runs."""
        importlib.import_module(f"{__package__}.{self.module}").run(options)


_ENTRIES = (
    Entry(
        name="ancf",
        module="reports.ancf",
        summary="ANCF beams, shells and solids against closed forms and other programs",
        about="The ANCF elements against references that were not made with warpfea (tests/data of a checkout), for "
        "every integration.",
        parts=(
            ("static_beam", "a cantilever beside Project Chrono's rows"),
            ("static_shell", "the same as one row of shells"),
            ("rollup", "a beam rolled into a circle"),
            ("princeton", "the Princeton beam beside the exact beam"),
            ("frequencies", "of a cantilever beam and a plate"),
            ("pendulum", "a flexible pendulum beside a spectral solution"),
            ("slender", "beam and plate of slenderness 1000"),
            ("manufactured", "orders of all solids in h, on a cube"),
            ("manufactured_structures", "the same of beam and plate"),
        ),
        options=("device", "only", "quick"),
        example="--out tests/results/ancf_reference.json",
        results=("ancf_reference.json",),
    ),
    Entry(
        name="mechanisms",
        module="reports.mechanisms",
        summary="joints against mechanisms computed without warpfea",
        about="Mechanisms against closed forms and models that share no equation with warpfea. no_drift takes long: "
        "it keeps a checkpoint beside --out, and the same command goes on from it after an interruption.",
        parts=(
            ("rigid_slider_crank", "so stiff that it follows the closed form"),
            ("flexible_slider_crank", "an elastic rod beside a floating frame"),
            ("double_pendulum", "two stiff links beside rigid ones"),
            ("hanging_chain", "reactions beside the weight below each joint"),
            ("free_fall", "two tied bodies fall as one"),
            ("no_drift", "violation over a hundred thousand steps"),
        ),
        options=("device", "only", "quick"),
        example="--only free_fall --quick",
        takes="about an hour",
        results=("mechanisms.json",),
    ),
    Entry(
        name="mechanism-models",
        module="reports.mechanisms.checks",
        summary="checks of the reference models that `mechanisms` uses",
        about="Prints how far the reference models are from differences, from a chain of point masses and from their "
        "own limits: the numbers that their docstrings quote.",
        out="",
        takes="a minute",
    ),
    Entry(
        name="joints",
        module="reports.joints",
        summary="cost and stability of constraints",
        about="ms per step and iterations of chains with 10 to 1000 joints for several ways to solve for the "
        "multipliers, and cases that are hard: mass ratios to 1e4, E from 1e4 to 1e12 Pa, redundant hinges, a linkage "
        "through its dead points.",
        parts=(("cost", "chains of m links on m joints"), ("stability", "hard cases")),
        options=("device", "only", "steps", "joints"),
        example="--steps 40 --out tests/results/joints_cpu.json",
        results=("joints_cpu.json", "joints_h200.json"),
    ),
    Entry(
        name="contact",
        module="reports.contact",
        summary="contact beside Hertz, Mindlin and finer runs, and at rest",
        about="A rigid sphere pressed into a deep block and moved sideways: contact radius, peak pressure, stiffnesses "
        "and full slip beside the closed forms. An elastic ball thrown at a plane beside a quarter of the step and "
        "half the mesh size. A cube pressed to a wall, and one on a plate that turns: how far they move where "
        "friction holds them. Two elastic balls and cylinders pressed together beside Hertz; a stack of cubes at rest.",
        parts=(
            ("hertz", "contact radius and peak pressure"),
            ("mindlin", "tangential stiffness and full slip"),
            ("rebound", "restitution and duration of an impact"),
            ("wall", "no creep in 10 s"),
            ("turntable", "no walk in ten turns"),
            ("balls", "two elastic balls beside Hertz"),
            ("cylinders", "two elastic cylinders beside Hertz"),
            ("stack", "ten cubes that rest"),
        ),
        options=("device", "only"),
        example="--out tests/results/contact_hertz_cpu.json",
        results=("contact_hertz_cpu.json", "contact_rest_cpu.json", "contact_pairs_cpu.json"),
    ),
    Entry(
        name="conservation",
        module="reports.conservation",
        summary="energy and momenta of the integrator energy_momentum over ten thousand steps",
        about="Free bodies of every family and law that tumble with large strains, and mechanisms without damping: the "
        "largest errors of energy and of both momenta. revolutions takes long: it keeps a checkpoint beside --out, and "
        "the same command goes on from it after an interruption.",
        parts=(
            *((family, "a tumbling body of each law") for family in ("T4", "T10", "ENMC", "FN", "H3843")),
            ("3243", "of each integration"),
            ("3443", "of each integration"),
            ("constrained", "mechanisms without damping"),
            ("revolutions", "ten thousand turns of two bodies"),
        ),
        options=("device", "only", "quick"),
        example="--out tests/results/conservation_cpu.json",
        takes="an hour",
        results=("conservation_cpu.json",),
    ),
    Entry(
        name="adaptive",
        module="reports.adaptive",
        summary="dt='auto' beside the error asked for and the best fixed step",
        about="Five motions (stiff, an impact of load, a dead point, free flight, contact) with backward Euler and "
        "BDF2: true errors for errors asked for of 1e-2 to 1e-5, and Newton iterations beside fixed steps.",
        example="--out tests/results/adaptive_cpu.json",
        results=("adaptive_cpu.json",),
    ),
    Entry(
        name="contact-integrators",
        module="surveys.contact_integrators",
        summary="scenes with contact, with every integrator: orders and dissipation",
        about="The scenes with contact, shortened, with backward Euler, BDF2, energy_momentum and generalized_alpha "
        "against finer runs: errors, orders, and what scheme and contact dissipate by the energy ledger.",
        options=("device", "quick"),
        example="--out tests/results/contact_integrators_cpu.json",
        results=("contact_integrators_cpu.json",),
    ),
    Entry(
        name="spinning",
        module="surveys.spinning",
        summary="energy that generalized-alpha adds to bodies that spin, for each rho_inf",
        about="A bar of 0.5 x 0.2 x 0.1 m that spins, free or on a joint, in 300 steps of 0.1 to 1 rad: the largest "
        "energy over that of the start for rho_inf from 0 to 0.9 and E from 1e7 to 2e11 Pa.",
        options=("device", "quick"),
        example="--out tests/results/spinning_cpu.json",
        results=("spinning_cpu.json",),
    ),
    Entry(
        name="precision",
        module="surveys.precision",
        summary="at which error rounding ends the curve of float32, for each family",
        about="The problem small_body of each family with BDF2 in float64 and float32 over a range of steps, against "
        "finer float64 runs.",
        options=("device", "quick"),
        example="--out tests/results/precision_cpu.json",
        results=("precision_cpu.json",),
    ),
    Entry(
        name="jacobi",
        module="reports.jacobi",
        summary="error and cost of the solver wf.Jacobi beside Newton's method",
        about="Four scenes with 2 to 32 iterations, with and without the coarse space, and each acceleration: error "
        "of the tip, ms per step, and what the steps say is left.",
        options=("device", "steps"),
        example="--out tests/results/jacobi_cpu.json",
        results=("jacobi_cpu.json",),
    ),
    Entry(
        name="floor",
        module="reports.floor",
        summary="the error of float32 that reports tell, beside the true one",
        about="Random strips loaded in their plane, of five kinds of elements, in statics and motion: what "
        "StepReport.floor tells, and the error against float64.",
        options=("device", "quick"),
        example="--out tests/results/floor_cpu.json",
        results=("floor_cpu.json",),
    ),
    Entry(
        name="identify",
        module="reports.identify",
        summary="stiffness and damping from a recorded, noisy motion, over many worlds",
        about="A finger of rubber is let go under gravity; scipy's differential evolution finds E and eta from the "
        "noisy record of its tip, a generation of candidates at a time, each a world of one model.",
        options=("device", "worlds", "quick"),
        example="--device cpu --out tests/results/identify_cpu.json",
        results=("identify_cpu.json", "identify_h200.json"),
    ),
    Entry(
        name="devices",
        module="reports.devices",
        summary="a CUDA device against the CPU, in both precisions",
        about="Every kind of element, law, load and constraint on both devices: differences over the tip's travel.",
        options=("device", "steps"),
        example="--device cuda:0 --out tests/results/device_agreement.json",
        results=("device_agreement.json",),
    ),
    Entry(
        name="versions",
        module="reports.versions",
        summary="run times of two versions, alternated",
        about="Runs `warpfea bench` with the package of another checkout and with this one in turns, and compares the "
        "medians of ms per step and the iterations, row by row.",
        options=("before", "bench", "repeat"),
        example="--before ../before --bench '--cpu --limit 5' --repeat 5 --out tests/results/versions_cpu.json",
        results=("versions_cpu.json", "versions_h200.json", "hard_steps_cpu.json", "hard_steps_h200.json"),
    ),
)
STUDIES: dict[str, Entry] = {entry.name: entry for entry in _ENTRIES}
"""By name."""
