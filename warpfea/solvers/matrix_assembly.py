"""H as a matrix of 3x3 blocks: its sparsity pattern, and its assembly on the device in a fixed order.

Preconditioners and direct solvers are built from it. It is also the operator where a product with the matrix is cheaper
than one with the elements (many quadrature points per slot).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..base.errors import ModelError
from ..kernels.common.structs import pattern_struct
from ..kernels.elements.matrix import panel_layout, panel_row_type
from ..kernels.solvers.blocks import assembly_kernels
from ..model.assembly import slot_graph
from ..terms.protocols import Coupled, Preconditioned

if TYPE_CHECKING:
    from ..base.launch import Launcher
    from ..model.model import Model
    from ..terms.workspace import Workspace

__all__ = [
    "MatrixAssembler",
    "Pattern",
    "couples_slots",
    "coupling_pattern",
    "leading_view",
    "make_pattern",
    "worlds_per_chunk",
]

MAX_FULL_FACTOR_SLOTS = 160
"""Largest number of slots (3-vector unknowns) of a model factored as a whole: in a band of any width, or else as a
dense matrix, with the couplings of bodies in contact."""


def transposed_entries(graph: sp.csr_matrix) -> np.ndarray:
    """Position of the entry (j, i) for each entry (i, j) of a symmetric pattern with sorted rows, (entries,)."""
    rows = np.repeat(np.arange(graph.shape[0]), np.diff(graph.indptr))
    return np.lexsort((rows, graph.indices)).argsort()


@dataclass(eq=False)
class Pattern:
    """A symmetric pattern of 3x3 blocks.

    Attributes:
        graph: the pattern on the host, rows sorted.
        data: device struct of the same tables.
        upper_entries: (m, 4) (entry, its transpose, row, column) of the blocks on the diagonal and above.
        entry_count, mean_row_length: number of blocks, and of those in a row on average.
    """

    graph: sp.csr_matrix
    data: Any
    upper_entries: np.ndarray

    def __post_init__(self) -> None:
        self.entry_count = len(self.graph.indices)
        self.mean_row_length = self.entry_count // max(self.graph.shape[0], 1)

    def find_upper(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Indices into `upper` of entries (row, column) on or above the diagonal; -1 for others."""
        n = np.int64(self.graph.shape[0])
        key = self.upper_entries[:, 2].astype(np.int64) * n + self.upper_entries[:, 3]
        wanted = np.asarray(rows).astype(np.int64) * n + columns
        at = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
        return np.where(key[at] == wanted, at, -1)


def make_pattern(model: Model, graph: sp.csr_matrix, *, with_upper: bool = True) -> Pattern:
    """Pattern and its device struct; `with_upper=False` omits `upper_entries`, which only assembly needs."""
    data = pattern_struct()()
    data.start = model.array("matrix pattern", graph.indptr, wp.int32)
    data.column = model.array("matrix pattern", graph.indices, wp.int32)
    upper = np.zeros((0, 4), dtype=np.int32)
    if with_upper:
        rows = np.repeat(np.arange(graph.shape[0], dtype=np.int32), np.diff(graph.indptr))
        chosen = np.flatnonzero(rows <= graph.indices)
        mirror = transposed_entries(graph)[chosen]
        upper = np.stack([chosen, mirror, rows[chosen], graph.indices[chosen]], axis=1).astype(np.int32)
        data.upper = model.array("matrix pattern", upper, wp.vec4i)
    return Pattern(graph, data, upper)


def couples_slots(model: Model) -> bool:
    """True if matrices hold the couplings of bodies by terms, as of a model factored as a whole."""
    return model.slots <= MAX_FULL_FACTOR_SLOTS


def coupling_pattern(model: Model) -> sp.csr_matrix:
    """Pattern (slots, slots) of slots that share an element, an item of a term or a point mass, or in small models may
    come in contact; rows sorted."""
    if "coupled slots" not in model.cache:
        graph = slot_graph(model.blocks, model.slots)
        for item, slot, count in filter(None, (term.incidence() for term in model.terms.having(Preconditioned))):
            touched = sp.csr_matrix((np.ones(len(item), dtype=np.int8), (item, slot)), (count, model.slots))
            touched.data[:] = 1
            graph = graph + sp.csr_matrix(touched.T.astype(np.int32) @ touched.astype(np.int32)).astype(np.int8)
        for term in model.terms.having(Coupled) if couples_slots(model) else ():
            a, b = term.coupled_slot_pairs()
            one_sided = sp.csr_matrix((np.ones(len(a), dtype=np.int8), (a, b)), graph.shape)
            graph = graph + one_sided + one_sided.T
        if any(body.point_masses for body in model.bodies):  # of the nodes of a set, which share no element
            graph = graph + (model.masses.matrix != 0.0).astype(np.int8)
        graph = graph.tocsr()
        graph.sort_indices()
        model.cache["coupled slots"] = graph
    return model.cache["coupled slots"]


MIN_CHUNK_WORLDS, MAX_CHUNKS = 512, 16
"""Worlds assembled at once: at least MIN_CHUNK_WORLDS, and enough for at most MAX_CHUNKS passes."""

MAX_SCRATCH_BYTES = 2**28
"""Scratch of enlarged chunks: a bound that is small beside the states that an adjoint keeps."""


def worlds_per_chunk(worlds: int) -> int:
    """Number of worlds assembled at once."""
    return min(worlds, max(MIN_CHUNK_WORLDS, -(-worlds // MAX_CHUNKS)))


class MatrixAssembler:
    """Assembly of the elements' part of H, c_M M + (dq/dv) K; terms add their `blocks` to it.

    Rows and columns of prescribed components are zero.

    Scratch covers a chunk of worlds; worlds are independent, so chunking is bitwise neutral.

    Attributes:
        worlds_per_chunk: worlds assembled at once.
        whole_elements: one thread computes a whole element matrix (CPU), else one column of it (GPU).
    """

    def __init__(
        self, model: Model, work: Workspace, launch: Launcher, element_kernels: list[Any], whole: bool | None = None
    ) -> None:
        self.model, self.work, self.launch = model, work, launch
        self.element_kernels = element_kernels
        self.whole_elements = not model.device.is_cuda if whole is None else whole
        if "matrix" not in model.cache:
            model.cache["matrix"] = self._make_pattern_and_mass()
        self.pattern: Pattern = model.cache["matrix"][0]
        self.blocks_by_elements = self._group_blocks_by_elements()
        name = f"contributions to the matrix, {'whole elements' if self.whole_elements else 'columns'}"
        if name not in model.cache:
            model.cache[name] = [self._list_contributions(parts[0][0]) for parts in self.blocks_by_elements]
        self.contributions: list[tuple[wp.array, wp.array]] = model.cache[name]
        vectors = max(self._element_matrices_size(block) for block in model.blocks)
        points = 0 if self.whole_elements else max(5 * block.points * block.count for block in model.blocks)
        self.scratch_sizes = {"element gradients": points, "element matrices": vectors}
        work.chunks |= dict.fromkeys(self.scratch_sizes, worlds_per_chunk)
        self._allocate_scratch(worlds_per_chunk(model.worlds))

    def _allocate_scratch(self, worlds: int) -> None:
        self.worlds_per_chunk, vec3 = worlds, self.model.types.vec3
        arrays = [self.work.array(name, (worlds, size), vec3) for name, size in self.scratch_sizes.items()]
        self.element_gradients, self.element_matrices = arrays

    def enlarge_chunks(self, most: int = MAX_SCRATCH_BYTES) -> None:
        """Assemble as many worlds at once as scratch of `most` bytes holds: fewer launches, for more memory."""
        each = sum(self.scratch_sizes.values()) * wp.types.type_size_in_bytes(self.model.types.vec3)
        worlds = min(self.model.worlds, most // each)
        if worlds > self.worlds_per_chunk:
            self._allocate_scratch(worlds)

    def _make_pattern_and_mass(self) -> tuple[Pattern, wp.array]:
        """Build the pattern and the masses of its upper entries."""
        model = self.model
        pattern = make_pattern(model, coupling_pattern(model))
        return pattern, model.array("matrix pattern", model.masses.pattern_masses(pattern), model.types.T)

    def modules(self) -> set[wp.Module]:
        """Modules launched by assembly."""
        out = {
            (k.element_matrix_panels if self.whole_elements else k.element_matrix).module for k in self.element_kernels
        }
        out |= {self._assembly_kernels(block).module for block in self.model.blocks}
        return out.union(*(term.block_modules() for term in self.model.terms.having(Preconditioned)))

    def _group_blocks_by_elements(self) -> list[list[tuple[Any, Any]]]:
        """Element blocks and their kernels, those of the same elements together (parts of one energy, as of ANCF)."""
        groups: list[list[tuple[Any, Any]]] = []
        connectivities: list[np.ndarray] = []
        for block, kernels in zip(self.model.blocks, self.element_kernels):
            conn = block.connectivity
            for k, other in enumerate(connectivities):
                if np.array_equal(conn, other):
                    groups[k].append((block, kernels))
                    break
            else:
                connectivities.append(conn)
                groups.append([(block, kernels)])
        return groups

    def _assembly_kernels(self, block: Any) -> Any:
        """Kernels that add a block's elements."""
        return assembly_kernels(self.model.dtype, block.slots, self.whole_elements)

    def _element_matrices_size(self, block: Any) -> int:
        """Number of 3-vectors in the matrices of a block's elements."""
        if self.whole_elements:
            _, width, rows = panel_layout(block.slots)
            return 3 * width * rows * block.count
        return 3 * block.slots * (block.slots + 1) // 2 * block.count

    def _list_contributions(self, block: Any) -> tuple[wp.array, wp.array]:
        """Contribution lists (element entry -> matrix entry) built on the device by `list_contributions`."""
        model = self.model
        kernels = self._assembly_kernels(block)
        if 2 * kernels.blocks_per_element * block.count >= 2**31:
            raise ModelError(
                f"matrix too large to index: {block.count} elements of {block.slots} slots, at most "
                f"{2**30 // kernels.blocks_per_element} such elements; use preconditioner='block-jacobi' with "
                "operator='elements'"
            )
        upper = len(self.pattern.upper_entries)
        start = wp.zeros(upper + 1, dtype=wp.int32, device=model.device)
        source = wp.zeros(0, dtype=wp.int32, device=model.device)
        find = kernels.list_contributions
        args = [model.topology, self.pattern.data, block.data.conn, block.contribution_offset, block.count]
        wp.launch(find, upper, inputs=[*args, 0, start, source], device=model.device)
        wp.utils.array_scan(start, start, inclusive=True)
        source = wp.empty(int(start[-1:].numpy()[0]), dtype=wp.int32, device=model.device)
        wp.launch(find, upper, inputs=[*args, 1, start, source], device=model.device)
        model.memory.count("matrix pattern", start, source)
        return start, source

    def allocate_values(self, name: str, worlds: int | None = None) -> wp.array:
        """New array of block values [world, entry]; `worlds`: the size of a chunk, see `chunk_view`."""
        return self.work.array(name, (worlds or self.model.worlds, self.pattern.entry_count), self.model.types.mat33)

    def chunk_view(self, values: wp.array, first: int) -> wp.array:
        """Chunk array indexed as [world, entry] over all worlds; only rows from `first` on exist."""
        out: Any = wp.array(
            ptr=values.ptr - first * values.strides[0], dtype=values.dtype, device=values.device,
            shape=(self.model.worlds, self.pattern.entry_count),
        )  # fmt: skip
        out._owner = values
        return out

    def assemble(
        self, iterate: Any, mass_factor: wp.array, active: wp.array, out: wp.array, *, projected: bool,
        worlds: range | None = None,
    ) -> None:  # fmt: skip
        """out = c_M M + (dq/dv) K at an iterate, as of `Workspace.iterate`; `mass_factor`: c_M per world.

        `projected`: K is made positive semi-definite at each quadrature point; it then depends on u and the factors
        only.
        `worlds`: the worlds to scan.
        """
        every = worlds or range(self.model.worlds)
        for first in range(every.start, every.stop, self.worlds_per_chunk):
            last = min(first + self.worlds_per_chunk, every.stop)
            state = [mass_factor, active, out]
            if last - first == self.model.worlds:
                self._assemble(last, iterate, state, projected)
                continue
            part = slice(first, last)
            with self.model.parameters.temporarily_restricted_to_worlds(first, last):
                own = self.work.iterate(iterate.u, iterate.v, iterate.dq_dv, part)
                self._assemble(last - first, own, [a[part] for a in state], projected, first)

    def _assemble(self, count: int, iterate: Any, state: list[wp.array], projected: bool, first_world: int = 0) -> None:
        """Assemble `count` worlds from `first_world` on; `iterate` and `state` hold their arrays."""
        m, launch = self.model, self.launch
        mass_factor, active, out = state
        mass = m.cache["matrix"][1]
        if mass.shape[0] != 1:
            mass = mass[first_world : first_world + count]
        for first, parts in enumerate(self.blocks_by_elements):
            for k, (block, elements) in enumerate(parts):
                data = self.work.data_of(block)
                given = [data, iterate, int(projected), active]
                if self.whole_elements:
                    _, width, rows = panel_layout(block.slots)
                    matrix = leading_view(
                        self.element_matrices, (count, block.count, rows), panel_row_type(m.dtype, width)
                    )
                    launch(elements.element_matrix_panels, (count, block.count), [*given, int(k > 0), matrix])
                    matrix = leading_view(self.element_matrices, (count, block.count, 9 * width * rows), m.types.T)
                    continue
                pairs = 3 * block.slots * (block.slots + 1) // 2
                matrix = leading_view(self.element_matrices, (count, pairs, block.count))
                gradients = leading_view(self.element_gradients, (count, 5 * block.points, block.count))
                points = (count, block.points, block.count)
                launch(elements.prepare_matrix, points, [*given, gradients])
                if block.key.tying and not projected:
                    launch(elements.prepare_stress, points, [data, iterate, active, gradients])
                args = [data, iterate, gradients, int(projected), int(k > 0), active, matrix]
                launch(elements.element_matrix, (count, 3 * block.slots * block.count), args)
            args = [m.topology, self.pattern.data, *self.contributions[first], matrix]
            args += [mass, int(first == 0), mass_factor, iterate.dq_dv, active, out]
            launch(self._assembly_kernels(block).add_element_matrices, (count, len(self.pattern.upper_entries)), args)

    def host_csr(self, values: wp.array, world: int = 0) -> sp.csr_matrix:
        """Blocks of one world as CSR (3 slots, 3 slots) on the host."""
        graph = self.pattern.graph
        data = values.numpy()[world].astype(float)
        n = 3 * self.model.slots
        return sp.bsr_matrix((data, graph.indices, graph.indptr), shape=(n, n)).tocsr()


def leading_view(array: wp.array, shape: tuple[int, ...], dtype: Any = None) -> wp.array:
    """The leading entries of an array as a view of another shape and type."""
    out: Any = wp.array(ptr=array.ptr, dtype=dtype or array.dtype, shape=shape, device=array.device)
    out._owner = array
    return out
