"""Families of 3243 beams with sections that are no rectangles: points that carry the section's area, and its faces."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np

from .ancf_beam import BEAM, HIGH, LOW
from .family import Family, ParentDomain, VtkSubdivision, known_family, register
from .outlines import Cell
from .quadrature import Rule
from .sections import BeamSection

__all__ = ["beam_family"]


def beam_family(section: BeamSection) -> Family:
    """The beam element with a section: `BEAM` for rectangles."""
    outer, inner, ends = section.cells
    if not outer:
        return BEAM
    data = [section.area_ratio, *(c.corners for c in (*outer, *inner, *ends)), *(c.bulge for c in (*outer, *ends))]
    digest = hashlib.sha256(repr([np.round(x, 12).tolist() for x in data if x is not None]).encode()).hexdigest()
    name = f"{BEAM.name} section {digest[:32]}"
    if (known := known_family(name)) is not None:
        return known
    scale = section.area_ratio

    def scaled(rule: Rule) -> Rule:
        return replace(rule, weights=scale * rule.weights)

    def scheme(parts: tuple) -> tuple:  # type: ignore[type-arg]
        return tuple(replace(part, rule=scaled(part.rule)) for part in parts)

    strips, caps = [*outer, *inner], [(x, cell) for x in (0.0, 1.0) for cell in ends]
    faces = [_cap(x, cell) for x, cell in caps] + [_strip(cell) for cell in strips]
    corners = np.concatenate([cell.corners[:1] for cell in outer])
    low, high = corners.min(axis=0), corners.max(axis=0)
    far = [corners[np.argmin(corners[:, 0])], corners[np.argmax(corners[:, 0])]]
    far += [corners[np.argmin(corners[:, 1])], corners[np.argmax(corners[:, 1])]]
    cap_parts, strip_parts = ((1, 6), (6, 2)) if ends[0].bulge is not None else ((1, 1), (6, 1))
    samples = np.stack([np.column_stack([np.full(len(corners), x), corners]) for x in (0.0, 1.0)])
    family = replace(
        BEAM,
        name=name,
        rules={key: scaled(rule) for key, rule in BEAM.rules.items()},
        schemes={key: scheme(parts) for key, parts in BEAM.schemes.items()},
        output_schemes={key: scheme(parts) for key, parts in BEAM.output_schemes.items()},
        curved_rule=scaled(BEAM.curved_rule),
        mass_rule=scaled(BEAM.mass_rule),
        curved_mass_rule=scaled(BEAM.curved_mass_rule),
        vertices=np.array([(x, *p) for x, p in zip((0.0, 0.0, 1.0, 1.0), far)]),
        parent=ParentDomain((LOW[0], *low.tolist()), (HIGH[0], *high.tolist())),
        faces=tuple(face for face, _ in faces),
        bulges={k: bulge for k, (_, bulge) in enumerate(faces) if bulge is not None},
        face_names=("start",) * len(ends) + ("end",) * len(ends) + ("side",) * len(outer) + ("bore",) * len(inner),
        face_shares=(1.0,) * len(caps) + (4.0 / len(outer),) * len(outer) + (4.0 / len(outer),) * len(inner),
        face_divisions=(cap_parts,) * len(caps) + (strip_parts,) * len(strips),
        node_samples=samples,
    )
    return register(replace(family, vtk_subdivision=_subdivision(family, len(ends), cap_parts)))


def _cap(x: float, cell: Cell) -> tuple[np.ndarray, np.ndarray | None]:
    """A cell of an end, outward, and its bulges at a = 0 and 1."""
    corners, bulge = cell.corners, cell.bulge
    if x == 0.0:
        corners, bulge = corners[[3, 2, 1, 0]], None if bulge is None else bulge[:, ::-1]
    face = np.column_stack([np.full(4, x), corners])
    return face, None if bulge is None else np.pad(bulge, ((0, 0), (0, 0), (1, 0)))


def _strip(cell: Cell) -> tuple[np.ndarray, np.ndarray | None]:
    """The face of a side along the element, outward."""
    b, a = cell.corners
    face = np.array([(0.0, *a), (1.0, *a), (1.0, *b), (0.0, *b)])
    return face, None if cell.bulge is None else np.tile(np.pad(cell.bulge[::-1], ((0, 0), (1, 0))), (2, 1, 1))


def _subdivision(family: Family, ends: int, parts: tuple[int, int]) -> VtkSubdivision:
    """Hexahedra over the cells of the end, four along the element."""
    a, b = (x.ravel() for x in np.meshgrid(*(np.linspace(0, 1, n + 1) for n in parts), indexing="ij"))
    grid = np.arange(len(a)).reshape(parts[0] + 1, parts[1] + 1)
    flat = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], axis=-1).reshape(-1, 4)
    layer = np.concatenate([family.face_points(k, np.column_stack([a, b]))[0] for k in range(ends, 2 * ends)])
    quads = np.concatenate([flat + k * len(a) for k in range(ends)])
    points = np.concatenate([layer * (0.0, 1.0, 1.0) + (x, 0.0, 0.0) for x in np.linspace(0.0, 1.0, 5)])
    cells = np.concatenate([np.hstack([quads, quads + len(layer)]) + k * len(layer) for k in range(4)])
    return VtkSubdivision(points, "hexahedron", cells)
