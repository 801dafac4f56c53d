"""Geometry of beams: from a curve and a section to nodes, their axes, and the frames dX/dxi of each element."""

import functools
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..base.errors import ModelError
from ..base.names import check_choice
from ..elements.sections import BeamSection
from ..mesh import Mesh

__all__ = ["beam_geometry", "spline"]

MAX_CORNER_ANGLE = math.radians(1.0)
"""Bend of a polyline, rad, above which it has a corner."""
MAX_KINK_ANGLE = 5.0
"""Maximum direction jump, degrees, of a curve given as a function."""
DIFFERENCE_STEPS = 32
"""Difference steps per element."""
FORWARD_WEIGHTS = np.array([-147.0, 360.0, -450.0, 400.0, -225.0, 72.0, -10.0]) / 60.0
"""Weights of f(0), f(h), ..., f(6 h) in h f'(0), of sixth order."""
SLOPE_ROUNDOFF = 1e-4
"""Relative difference of the one-sided derivatives at a node that counts as rounding."""
CHORDS_PER_ELEMENT = 8
"""Chords per element, for its total turning angle."""
MAX_HALVINGS = 16
"""Interval halvings in the search for a corner."""


def spline(points: Any, *, closed: bool = False) -> Callable[[float], np.ndarray]:
    """A smooth curve through points (n, 3), m, as a function of s in [0, 1]: cubic, parameterised by chord length.

    Args:
        closed: join the last point to the first smoothly; the ends of a beam along it stay two nodes.

    Raises:
        ModelError: fewer than three points, points that repeat or are not finite.
    """
    from scipy.interpolate import CubicSpline

    x = np.asarray(points, dtype=float)
    if x.ndim != 2 or x.shape[1] != 3 or len(x) < 3 or not np.all(np.isfinite(x)):
        raise ModelError(f"spline: points must be finite, of shape (n, 3) with n >= 3, got shape {x.shape}")
    if closed:
        x = np.vstack([x, x[:1]])
    size = np.linalg.norm(np.diff(x, axis=0), axis=1)
    if not size.min() > 0.0:
        raise ModelError(f"spline: point {int(np.argmin(size)) + 1} repeats the one before")
    at = np.concatenate([[0.0], np.cumsum(size)]) / size.sum()
    curve = CubicSpline(at, x, bc_type="periodic" if closed else "not-a-knot" if len(x) > 3 else "natural")
    return lambda s: np.asarray(curve(s))


@dataclass(frozen=True, eq=False)
class _Curve:
    """Curve of a parameter s in [0, 1]: position, one-sided derivative, and admissible element ends.

    Attributes:
        position: s -> (3,) m.
        derivative: (s, side) -> dX/ds (3,), side -1 or 1.
        corner_parameters: parameters of corners (nodes there).
        turning_angles: total turning angle of each element, degrees, if not determined by its ends.
    """

    position: Callable[[float], np.ndarray]
    derivative: Callable[[float, int], np.ndarray]
    corner_parameters: tuple[float, ...] = ()
    turning_angles: np.ndarray | None = None


def beam_geometry(
    name: str, curve: Any, elements: int, section: BeamSection, normal: Any, corners: str
) -> tuple[Mesh, np.ndarray, np.ndarray]:
    """Nodes and frames of a beam.

    Returns:
        Mesh of line cells with the node sets "start" and "end"; node axes (nodes, 3, 3) with columns along the axis,
        the width and the height; frames (elements, 2, 3, 3) = dX/dxi in those axes, m.

    Raises:
        ModelError: as ModelBuilder.add_beam.
    """
    if isinstance(elements, bool) or not (isinstance(elements, (int, np.integer)) and elements >= 1):
        raise ModelError(f"body {name!r}: elements = {elements!r} must be a positive whole number")
    check_choice(f"body {name!r}: corners", corners, ("error", "weld"))
    axis_curve = _make_curve(name, curve, int(elements), corners)
    s = _node_parameters(name, int(elements), axis_curve.corner_parameters)
    points = np.array([axis_curve.position(k) for k in s])
    slope = axis_curve.derivative
    ends = [(slope(a, 1) * (b - a), slope(b, -1) * (b - a)) for a, b in itertools.pairwise(s)]
    _check_turning_angles(name, s, ends, axis_curve.turning_angles, sharp_allowed=bool(axis_curve.corner_parameters))
    tangents = [(x, k) for e, pair in enumerate(ends) for x, k in zip(pair, s[e : e + 2])]
    frames = np.array([_section_frame(name, x, k, section, normal) for x, k in tangents]).reshape(-1, 2, 3, 3)
    axes = np.concatenate([frames[:, 0], frames[-1:, 1]])
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    cells = np.column_stack([np.arange(elements), np.arange(elements) + 1])
    sets = {"start": np.array([0]), "end": np.array([int(elements)])}
    local = np.einsum("enck,encl->enkl", axes[cells], frames)
    return Mesh(points, cells, "line", node_sets=sets, name=name), axes, local


def _check_turning_angles(
    name: str, s: np.ndarray, ends: list[tuple[Any, Any]], along: np.ndarray | None, *, sharp_allowed: bool
) -> None:
    """Refuse elements that turn too far for a cubic, and kinks between elements."""
    turns = np.array([float(_angles_between(np.array(pair))[0]) for pair in ends])
    if along is not None:
        turns = np.maximum(turns, along)
    worst = int(np.argmax(turns))
    if turns[worst] > 100.0:
        raise ModelError(
            f"body {name!r}: element {worst} (s = {s[worst]:.3g} to {s[worst + 1]:.3g}) turns by {turns[worst]:.3g} "
            f"degrees; use elements = {math.ceil(len(ends) * turns[worst] / 20.0)} or more, for 20 degrees each"
        )
    for k in range(1, len(ends)):
        kink = float(_angles_between(np.array([ends[k - 1][1], ends[k][0]]))[0])
        if kink > MAX_KINK_ANGLE and not sharp_allowed:
            _raise_corner_error(name, kink, s[k])


def _raise_corner_error(name: str, angle: float, s: float) -> None:
    raise ModelError(
        f"body {name!r}: the curve has a corner of {angle:.3g} degrees at s = {s:.3g}; give a smooth curve, "
        "one beam per side, or a polyline with corners='weld'"
    )


def _angles_between(lines: np.ndarray) -> np.ndarray:
    """Angles (degrees) between successive vectors (n, 3), (n - 1,); 0 next to a zero vector."""
    a, b = lines[:-1], lines[1:]
    across = np.linalg.norm(np.cross(a, b), axis=1)
    return np.degrees(np.arctan2(across, np.sum(a * b, axis=1)))


def _section_frame(name: str, tangent: np.ndarray, s: float, section: BeamSection, normal: Any) -> np.ndarray:
    """(3, 3) columns: tangent (unscaled), width and height vectors."""
    length = float(np.linalg.norm(tangent))
    if not (math.isfinite(length) and length > 0.0):
        raise ModelError(f"body {name!r}: the curve has a zero or non-finite tangent at s = {s:.4g}")
    t = tangent / length
    try:
        up = np.asarray(normal(s) if callable(normal) else normal, dtype=float)
    except (TypeError, ValueError):
        up = np.zeros(0)
    if up.shape != (3,) or not np.all(np.isfinite(up)):
        raise ModelError(f"body {name!r}: normal must be three finite numbers or a function of s, got {normal!r}")
    n = up - (up @ t) * t
    size = float(np.linalg.norm(n))
    if not size > 1e-6 * float(np.linalg.norm(up)):
        raise ModelError(
            f"body {name!r}: normal {up.tolist()} lies along the beam's axis at s = {s:.4g}; give one across it"
        )
    n /= size
    width, height = section.sides_at(s)
    across, up, c, d = np.cross(n, t), n, math.cos(section.angle), math.sin(section.angle)
    if d:
        across, up = c * across + d * up, c * up - d * across
    return np.stack([tangent, width * across, height * up], axis=1)


def _node_parameters(name: str, elements: int, corner_parameters: tuple[float, ...]) -> np.ndarray:
    """Node parameters, evenly spaced between corners, which are nodes."""
    if not corner_parameters:
        return np.linspace(0.0, 1.0, elements + 1)
    edges = np.array([0.0, *corner_parameters, 1.0])
    share = np.diff(edges)
    if elements < len(share):
        raise ModelError(f"body {name!r}: {elements} elements for {len(share)} sides; each side needs one at least")
    counts = np.ones(len(share), dtype=int)
    for _ in range(elements - len(share)):
        counts[int(np.argmax(share / counts))] += 1
    parts = [np.linspace(a, b, n + 1)[:-1] for a, b, n in zip(edges[:-1], edges[1:], counts)]
    return np.concatenate([*parts, [1.0]])


def _make_curve(name: str, curve: Any, elements: int, corners: str) -> _Curve:
    if callable(curve):
        return _function_curve(name, curve, elements)
    ends = np.asarray(curve, dtype=float)
    if ends.ndim != 2 or ends.shape[1] != 3 or len(ends) < 2 or not np.all(np.isfinite(ends)):
        raise ModelError(
            f"body {name!r}: the curve must be finite points (n, 3), m, or a function of s; got shape {ends.shape}"
        )
    chord = np.diff(ends, axis=0)
    size = np.linalg.norm(chord, axis=1)
    if not size.min() > 0.0:
        raise ModelError(f"body {name!r}: point {int(np.argmin(size)) + 1} of the curve repeats the one before")
    straight = chord / size[:, None]
    bend = np.arccos(np.clip(np.sum(straight[1:] * straight[:-1], axis=1), -1.0, 1.0))
    sharp = np.flatnonzero(bend > MAX_CORNER_ANGLE)
    if len(sharp) and corners == "error":
        k = int(sharp[0]) + 1
        raise ModelError(
            f"body {name!r}: the polyline has a corner of {math.degrees(bend[k - 1]):.3g} degrees at point {k}. Give a "
            "smooth function of s, one beam per side, or corners='weld', which makes a rigid corner (both sides share "
            "the deformation gradient there)"
        )
    if len(sharp) and np.any(bend[sharp] > math.radians(150.0)):
        raise ModelError(f"body {name!r}: the polyline folds back on itself at point {int(sharp[0]) + 1}")
    at = np.concatenate([[0.0], np.cumsum(size)]) / size.sum()

    def side(s: float, which: int) -> np.ndarray:
        k = np.searchsorted(at, s + which * 1e-9, side="right") - 1
        return straight[min(max(int(k), 0), len(straight) - 1)] * size.sum()

    corner_parameters = tuple(at[1:-1][bend > 0.0]) if len(sharp) else ()
    return _Curve(lambda s: np.array([np.interp(s, at, ends[:, c]) for c in range(3)]), side, corner_parameters)


def _function_curve(name: str, curve: Callable[[float], Any], elements: int) -> _Curve:
    """Smooth curve. The derivative at an element's end is taken from points within the element.

    It is therefore valid for any number of turns and at junctions of arcs and lines; the function is evaluated in
    [0, 1] only. Neighbours share the mean derivative, so that their sections coincide, except at bends and jumps of
    the speed.
    """

    def at(s: float) -> np.ndarray:
        out = np.asarray(curve(s), dtype=float)
        if out.shape != (3,):
            raise ModelError(f"body {name!r}: the curve must return three numbers (m), it returned shape {out.shape}")
        if not np.all(np.isfinite(out)):
            raise ModelError(
                f"body {name!r}: the curve must be finite for every s in [0, 1]; it is {out.tolist()} at s = {s:.4g}"
            )
        return out

    def one_sided_derivative(s: float, side: int) -> np.ndarray:
        h = side / (DIFFERENCE_STEPS * elements)
        return FORWARD_WEIGHTS @ np.array([at(min(max(s + k * h, 0.0), 1.0)) for k in range(len(FORWARD_WEIGHTS))]) / h

    @functools.lru_cache(maxsize=2)
    def side_derivatives(s: float) -> tuple[np.ndarray, np.ndarray]:
        if s in (0.0, 1.0):
            end = one_sided_derivative(s, 1 if s == 0.0 else -1)
            return end, end
        left, right = one_sided_derivative(s, -1), one_sided_derivative(s, 1)
        if np.linalg.norm(left - right) < SLOPE_ROUNDOFF * np.linalg.norm(left + right):
            left = right = 0.5 * (left + right)
        return left, right

    def slope(s: float, side: int) -> np.ndarray:
        return side_derivatives(s)[(side + 1) // 2]

    return _Curve(at, slope, turning_angles=_turning_angles(name, at, elements))


def _turning_angles(name: str, at: Callable[[float], np.ndarray], elements: int) -> np.ndarray:
    """Turning angles (degrees) of the chords within each element, summed. ModelError for a corner of the curve."""
    grid = np.linspace(0.0, 1.0, CHORDS_PER_ELEMENT * elements + 1)
    turns = _angles_between(np.diff([at(s) for s in grid], axis=0))
    pairs = turns + np.append(turns[1:], 0.0)  # a corner between two points of the grid is split between both
    for k in np.flatnonzero(pairs > 2.0 * MAX_KINK_ANGLE):
        low, high = grid[k], grid[min(int(k) + 3, CHORDS_PER_ELEMENT * elements)]
        angle, where = _sharpest_turn(at, low, high)
        if angle > MAX_KINK_ANGLE:
            _raise_corner_error(name, angle, where)
    inner = np.append(turns, 0.0).reshape(elements, CHORDS_PER_ELEMENT)[:, :-1]
    return np.asarray(inner.sum(axis=1))


def _sharpest_turn(at: Callable[[float], np.ndarray], low: float, high: float) -> tuple[float, float]:
    """Largest direction change (degrees) of a curve under interval refinement, and its parameter.

    It tends to 0 with the interval for a smooth curve, not for a corner.
    """
    for _ in range(MAX_HALVINGS):
        s = np.linspace(low, high, 5)
        turns = _angles_between(np.diff([at(k) for k in s], axis=0))
        if turns.sum() <= MAX_KINK_ANGLE:
            break
        k = int(np.argmax(turns))
        low, high = float(s[k]), float(s[k + 2])
    return float(turns.sum()), 0.5 * (low + high)
