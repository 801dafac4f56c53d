"""Nodes, elements and sets of an Abaqus .inp file with one part."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..base.errors import MeshError
from .assemble import RawMesh
from .cells import CELL_TYPES, Ints, cell_dimension

__all__ = ["read_inp"]

_SOLID_CELLS = {4: "tetra", 5: "pyramid", 6: "wedge", 8: "hexahedron", 10: "tetra10", 15: "wedge15", 20: "hexahedron20"}
_SURFACE_CELLS = {3: "triangle", 4: "quad", 6: "triangle6", 8: "quad8", 9: "quad9"}
_LINE_CELLS = {2: "line", 3: "line3"}
_UNSUPPORTED_KEYWORDS = {"INCLUDE", "NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY", "SYSTEM"}

Block = tuple[str, dict[str, str], list[str]]
Members = dict[str, list[Ints]]
"""Sets by name, as ids of nodes or elements."""


def read_inp(file: Path) -> RawMesh:
    """Read *NODE, *ELEMENT, *NSET, *ELSET and *SURFACE of type ELEMENT.

    Messages use the file's ids. Any number of *NODE and *ELEMENT blocks is accepted; reference nodes of the assembly
    are ignored. Face labels S1, S2, .. of solids and edge labels E1 .. E4 of shells are the
    local faces 0, 1, ...

    Raises
    ------
    MeshError
        Several parts, instances with a translation, generated nodes or elements, unknown element types, repeated or
        undefined ids, unknown face labels, bad numbers.
    """
    blocks = list(_keyword_blocks(file.read_text(encoding="utf-8", errors="replace")))
    for keyword, _, _ in blocks:
        if keyword in _UNSUPPORTED_KEYWORDS:
            raise MeshError(f"*{keyword} is not supported: write the nodes and elements out")
    blocks = _drop_assembly_data(blocks)

    node_rows = [(b, _parse_table(b[2], f"*NODE, {b[1].get('NSET', 'nodes')}")) for b in blocks if b[0] == "NODE"]
    if not node_rows:
        raise MeshError("not an Abaqus mesh, or truncated: there is no *NODE block")
    widths = {rows.shape[1] for _, rows in node_rows if rows.size}
    if widths != {4}:
        raise MeshError(
            f"*NODE lines have {sorted(widths)} numbers, expected an id and 3 coordinates: is this a 2D mesh?"
        )
    nodes = np.concatenate([rows for _, rows in node_rows if rows.size])
    node_ids = _IdMap(nodes[:, 0].astype(np.int64), "node")

    raw = RawMesh(nodes[:, 1:], [])
    node_members: Members = {}
    for block, rows in node_rows:
        if "NSET" in block[1]:
            node_members.setdefault(block[1]["NSET"], []).append(rows[:, 0].astype(np.int64))
    element_ids, members = _read_elements(raw, blocks, node_ids)
    ids = _IdMap(np.concatenate(element_ids) if element_ids else np.empty(0, dtype=np.int64), "element")
    starts = np.cumsum([0] + [len(e) for e in element_ids])

    for keyword, sets, option in (("NSET", node_members, "NSET"), ("ELSET", members, "ELSET")):
        for name, options, lines in ((b[1].get(option, ""), b[1], b[2]) for b in blocks if b[0] == keyword):
            sets.setdefault(name, []).extend(_set_members(lines, options, sets, f"*{keyword}, {name}"))
    raw.node_groups = {k: node_ids.index(np.concatenate(v), f"node set {k!r}") for k, v in node_members.items() if v}
    for name, parts in members.items():
        where = ids.index(np.concatenate(parts), f"element set {name!r}") if parts else np.empty(0, dtype=np.int64)
        owner = np.searchsorted(starts, where, side="right") - 1
        for k in np.unique(owner):
            raw.groups.append((name, int(k), where[owner == k] - starts[k]))
    _read_surfaces(raw, blocks, members, ids, starts)
    return raw


def _read_elements(raw: RawMesh, blocks: list[Block], node_ids: _IdMap) -> tuple[list[Ints], Members]:
    """Add the *ELEMENT blocks to the mesh; returns the element ids of each block, and the named sets."""
    element_ids: list[Ints] = []
    members: Members = {}
    for keyword, options, lines in blocks:
        if keyword != "ELEMENT":
            continue
        kind, count = _cell_type(options.get("TYPE", ""), len(lines))
        numbers = _parse_integers(lines, f"*ELEMENT, TYPE={options.get('TYPE')}")
        if len(numbers) % (count + 1):
            raise MeshError(
                f"*ELEMENT, TYPE={options['TYPE']}: {len(numbers)} numbers don't make elements of an id "
                f"and {count} nodes (truncated?)"
            )
        rows = numbers.reshape(-1, count + 1)
        raw.blocks.append(
            (kind, node_ids.index(rows[:, 1:], f"element id {{owner}} of type {options['TYPE']}", rows[:, 0]))
        )
        element_ids.append(rows[:, 0])
        if "ELSET" in options:
            members.setdefault(options["ELSET"], []).append(rows[:, 0])
    return element_ids, members


def _read_surfaces(raw: RawMesh, blocks: list[Block], members: Members, ids: _IdMap, starts: Ints) -> None:
    """Add the *SURFACE blocks of type ELEMENT to the mesh; `starts`: first element of each of its blocks."""
    labels = _face_labels([kind for kind, _ in raw.blocks])
    for keyword, options, lines in blocks:
        if keyword != "SURFACE" or options.get("TYPE", "ELEMENT").upper() != "ELEMENT":
            continue
        face_rows: list[Ints] = []
        for line in lines:
            who, _, label = (part.strip() for part in line.partition(","))
            if label.upper() not in labels:
                raise MeshError(
                    f"*SURFACE, NAME={options.get('NAME')}: unknown face label {label!r}, known are "
                    f"{labels[0]} .. {labels[-1]}"
                    + (" (edges); name whole shells by *ELSET" if labels[0] == "E1" else "")
                )
            known = members.get(who)
            wanted = np.concatenate(known) if known else np.array([_parse_integer(who, "*SURFACE")])
            where = ids.index(wanted, f"surface {options.get('NAME')!r}")
            owner = np.searchsorted(starts, where, side="right") - 1
            face_rows.append(np.column_stack([owner, where - starts[owner], np.full(len(where), int(label[1]) - 1)]))
        raw.faces[options.get("NAME", "surface")] = (
            np.concatenate(face_rows) if face_rows else np.empty((0, 3), dtype=np.int64)
        )


def _keyword_blocks(text: str) -> Iterator[Block]:
    """Keyword (upper case), options (upper-case keys) and data lines, comments removed."""
    lines = [line for line in map(str.strip, text.splitlines()) if line and not line.startswith("**")]
    starts = [k for k, line in enumerate(lines) if line.startswith("*")]
    for start, end in itertools.pairwise([*starts, len(lines)]):
        keyword, first = lines[start], start + 1
        while keyword.endswith(",") and first < end:  # continued
            keyword, first = keyword + lines[first], first + 1
        name, *options = (part.strip() for part in keyword[1:].split(","))
        pairs = (option.partition("=") for option in options if option)
        values = {key.strip().upper(): value.strip().strip('"') for key, _, value in pairs}
        yield name.upper(), values, lines[first:end]


def _drop_assembly_data(blocks: list[Block]) -> list[Block]:
    """Drop assembly-only data; refuse transformations of parts."""
    kept: list[Block] = []
    inside, part, instances = "", 0, 0
    with_nodes: set[int] = set()
    has_parts = any(keyword == "PART" for keyword, _, _ in blocks)
    for block in blocks:
        keyword, options, lines = block
        if keyword in ("PART", "ASSEMBLY"):
            inside = keyword
            part += keyword == "PART"
        elif keyword in ("END PART", "END ASSEMBLY"):
            inside = ""
        elif keyword == "INSTANCE":
            instances += 1
            if lines:
                raise MeshError(
                    f"instance {options.get('NAME')!r} is moved, which is not supported: apply it and save flat"
                )
        elif keyword == "NODE" and inside == "PART" and lines:
            with_nodes.add(part)
            kept.append(block)
        elif not (has_parts and inside == "ASSEMBLY" and keyword in ("NODE", "ELEMENT")):
            kept.append(block)
    if instances > 1 or len(with_nodes) > 1:
        raise MeshError(f"{len(with_nodes)} parts, {instances} instances are not supported: save one flat part")
    return kept


def _cell_type(name: str, lines: int) -> tuple[str, int]:
    """meshio cell type and node number of an Abaqus element type."""
    for pattern, table in (
        (r"C3D(\d+)[A-Z]*", _SOLID_CELLS),
        (r"(?:CPS|CPE|CPEG|CAX|M3D|SFM3D|R3D|S|DS|DC2D|AC2D|C2D)(\d)[A-Z]*\d?", _SURFACE_CELLS),
        (r"STRI(3|6)5?", _SURFACE_CELLS),
        (r"T[23]D(\d)[A-Z]*", _LINE_CELLS),
    ):
        found = re.fullmatch(pattern, name.upper())
        if found and int(found[1]) in table:
            return table[int(found[1])], int(found[1])
    beam = re.fullmatch(r"B[23]([123])[A-Z]*", name.upper())
    if beam:
        return ("line3", 3) if beam[1] == "2" else ("line", 2)
    raise MeshError(f"unknown element type {name!r} ({lines} lines)")


def _face_labels(kinds: list[str]) -> list[str]:
    """Labels valid in a *SURFACE: E1 .. E4 without solids, else S1, S2, ... of their faces."""
    solids = [kind for kind in kinds if cell_dimension(kind) == 3]
    if not solids:
        return ["E1", "E2", "E3", "E4"]
    most = max(len(CELL_TYPES[kind].faces) if kind in CELL_TYPES else 6 for kind in solids)
    return [f"S{k + 1}" for k in range(most)]


def _set_members(lines: list[str], options: dict[str, str], sets: dict[str, list[Ints]], where: str) -> Iterator[Ints]:
    """Id arrays of the lines of a set: numbers, ranges (GENERATE) or names of earlier sets."""
    if "GENERATE" in options:
        for line in lines:
            first, last, *step = _parse_integers([line], where)
            yield np.arange(first, last + 1, step[0] if step else 1)
        return
    words = [word for line in lines for word in (part.strip().strip('"') for part in line.split(",")) if word]
    numbers = [word for word in words if re.fullmatch(r"[+-]?\d+", word)]
    if numbers:
        yield np.array(numbers, dtype=np.int64)
    for word in words:
        if not re.fullmatch(r"[+-]?\d+", word):
            if word not in sets:
                raise MeshError(f"{where}: unknown set {word!r}")
            yield from list(sets[word])


def _parse_table(lines: list[str], where: str) -> np.ndarray:
    try:
        return np.array([[float(w) for w in line.split(",") if w.strip()] for line in lines], dtype=float)
    except ValueError as error:
        raise MeshError(f"{where}: bad line ({error})") from None


def _parse_integers(lines: list[str], where: str) -> Ints:
    return np.array([_parse_integer(w, where) for line in lines for w in line.split(",") if w.strip()], dtype=np.int64)


def _parse_integer(word: str, where: str) -> int:
    try:
        return int(word)
    except ValueError:
        raise MeshError(f"{where}: expected an integer, got {word.strip()!r}") from None


class _IdMap:
    """File ids -> positions in the file's order."""

    def __init__(self, ids: Ints, what: str) -> None:
        self.item_name = what
        self.order = np.argsort(ids, kind="stable")
        self.sorted_ids = ids[self.order]
        twice = np.flatnonzero(self.sorted_ids[1:] == self.sorted_ids[:-1])
        if twice.size:
            raise MeshError(f"{what} id {self.sorted_ids[twice[0]]} is defined twice (several parts in one file?)")

    def index(self, wanted: Ints, where: str, owners: Ints | None = None) -> Ints:
        """Positions of ids, of any shape; ``owners``: ids to name in the message, one per row."""
        at = np.minimum(np.searchsorted(self.sorted_ids, wanted), max(len(self.sorted_ids) - 1, 0))
        missing = np.argwhere(self.sorted_ids[at] != wanted) if len(self.sorted_ids) else np.argwhere(wanted == wanted)
        if missing.size:
            row = tuple(missing[0])
            place = where.format(owner=owners[row[0]]) if owners is not None else where
            raise MeshError(f"{place} refers to {self.item_name} {wanted[row]}, which the file does not define")
        return self.order[at]
