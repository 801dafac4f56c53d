"""Validation of a builder's arguments."""

import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from ..base.errors import MeshWarning, ModelError, ModelWarning
from ..base.names import did_you_mean, listing
from ..materials import Material
from ..mesh import Mesh
from ..model.assembly import require_density
from ..model.bodies import Body
from ..model.description import Description
from ..model.handles import ElementSet, MaterialPoint, NodeSet, SurfaceSet
from ..model.joints import Joint
from ..time_laws import Control, Rotation, TimeLaw, time_law

__all__ = [
    "COMPONENT_INDEX", "assign_materials", "body_of_handle", "check_densities", "checked_rotation", "component_mask",
    "joint_of", "nodal_vectors", "parse_gravity", "slot_field", "unit_vector", "vector", "warn_implausible",
]  # fmt: skip

COMPONENT_INDEX = {"x": 0, "y": 1, "z": 2}
SIZE_RANGE = (1e-6, 1e3)
"""Least and largest plausible size of a body, m: the longest side of its bounding box."""
MASS_RANGE = (1e-12, 1e7)
"""Least and largest plausible mass of a body, kg: a grain of dust, and more than a steel tower of 300 m."""
MIN_METAL_E, METAL_DENSITY = 1e6, 2500.0
"""Pa and kg/m^3: metals in MPa have at most 4.1e5; soft matter is lighter, dense rubber stiffer."""
MAX_NU = 0.499
"""Limit of nu for solids; above it volumetric locking of a coarse mesh dominates."""
MIN_DENSITY = 1.0
"""Least plausible density, kg/m^3: an aerogel; t/mm^3 are far below. Heavy bodies may stand for others."""
FOAM_DENSITY, MAX_FOAM_E = 25.0, 1e9
"""kg/m^3 and Pa: no lighter solid is stiffer, except densities given in g/cm^3."""
HANDLE_NAMES: dict[type, str] = {
    Body: "the body",
    NodeSet: "nodes (body.nodes)",
    SurfaceSet: "a surface (body.surface)",
    ElementSet: "elements (body.elements)",
    MaterialPoint: "a point (body.at)",
}


def body_of_handle(thing: Any, what: str, kinds: tuple[type, ...], bodies: list[Body]) -> Body:
    """Body of a handle, which must be non-empty, of one of the kinds and of one of the bodies.

    Raises:
        ModelError: otherwise; the text begins with `what`.
    """
    body = thing if isinstance(thing, Body) else getattr(thing, "body", None)
    wanted = " or ".join(HANDLE_NAMES[kind] for kind in kinds)
    if not isinstance(body, Body):
        hint = f"; write body.nodes({thing!r}) or body.surface({thing!r})" if isinstance(thing, str) else ""
        if isinstance(thing, str) and thing in [body.name for body in bodies]:
            hint = "; the handle of this body is what add_solid, add_beam, add_shell or add_rigid returned"
        raise ModelError(f"{what}: expected a handle of a body, {wanted}, got {thing!r}{hint}")
    if not isinstance(thing, kinds):
        raise ModelError(
            f"{what}: expected {wanted} of body {body.name!r}, got {HANDLE_NAMES.get(type(thing), HANDLE_NAMES[Body])}"
        )
    if body not in bodies:
        raise ModelError(f"{what}: body {body.name!r} belongs to another builder")
    if isinstance(thing, (NodeSet, SurfaceSet)) and len(thing) == 0:
        chosen = repr(thing.name) if thing.name else "of the predicate or list"
        raise ModelError(f"{what}: the selection {chosen} on body {body.name!r} is empty")
    if isinstance(thing, NodeSet) and not body.rigid:
        unused = thing.indices[body.node_slot[thing.indices] < 0]
        if len(unused) == len(thing.indices):
            raise ModelError(f"{what}: no element of body {body.name!r} uses node {int(unused[0])}")
    return body


def joint_of(thing: Any, what: str, joints: list[Joint]) -> Joint:
    """A joint by its handle or name. ModelError unless it is one of `joints`; the text begins with `what`."""
    for joint in joints:
        if thing is joint or (isinstance(thing, str) and thing == joint.name):
            return joint
    hint = did_you_mean(thing, [joint.name for joint in joints]) if isinstance(thing, str) else ""
    raise ModelError(f"{what}: {thing!r} is no joint of this builder{hint}")


def parse_gravity(value: Any) -> tuple[np.ndarray, TimeLaw | None]:
    """Gravity as (constant (3,), m/s^2, time law or None); the constant is zero with a law."""
    samples = isinstance(value, (tuple, list)) and len(value) == 2 and np.ndim(value[0]) == 1
    if samples or isinstance(value, (wp.Function, Control)) or callable(value):
        return np.zeros(3), time_law(value, "gravity")
    return vector(value, "gravity"), None


def check_densities(d: Description) -> None:
    """Raise ModelError for gravity or a body force on a material without density."""
    if np.any(d.gravity) or d.gravity_law is not None:
        require_density(d.bodies, "gravity, and by any motion")  # no hint "or gravity=(0, 0, 0)"
    for force in d.body_forces:
        require_density(force.bodies, "add_body_force")


def warn_implausible(model: Any) -> None:
    """Warn (MeshWarning) of a size, mass or density that suggests a wrong unit."""
    for body in model.bodies:
        _warn_of_materials(body)
        low, high = body.mesh.bounding_box()
        size = float(np.max(high - low))
        mass = None
        if all(material.density is not None for _, material in body.materials):
            mass = float(model.masses.lumped[0][body.slot_range][body.slot_kind == 0].sum())
        large = size > SIZE_RANGE[1] or (mass is not None and mass > MASS_RANGE[1])
        small = size < SIZE_RANGE[0] or (mass is not None and mass < MASS_RANGE[0])
        if not (large or small):
            continue
        what = f"is {size:.3g} m long" + ("" if mass is None else f" and weighs {mass:.3g} kg")
        hint = "lengths are in metres, density in kg/m^3"
        if body.mesh.path is not None:
            hint = f"check scale= of {body.mesh.label}: lengths are in metres"
            if large:
                hint = f"lengths are in metres; if {body.mesh.label} is in mm, give scale=1e-3 (--scale 1e-3)"
        warnings.warn(f"body {body.name!r} {what}: {hint}", MeshWarning, stacklevel=3)


def _warn_of_materials(body: Body) -> None:
    """Warn of densities in another unit, a metal with E probably in MPa, and of volumetric locking of solids."""
    for group, material in body.materials if body.elastic else ():  # else a stand-in, and a part may be hollow
        law = type(material).__name__ + (f" of group {group!r}" if group else "")
        lam, mu = material.lame
        E, nu = mu * (3.0 * lam + 2.0 * mu) / (lam + mu), lam / (2.0 * (lam + mu))
        given = material.density
        low = math.inf if given is None else float(np.min(given(body.mesh.points) if callable(given) else given))
        found: list[tuple[str, type[Warning]]] = []
        if low < (FOAM_DENSITY if E > MAX_FOAM_E else MIN_DENSITY):
            text = f"the density of {law} is {low:.3g} kg/m^3. Is it in another unit? Steel has 7850"
            found.append((text, MeshWarning))
        if E < MIN_METAL_E and METAL_DENSITY < low < math.inf and not callable(given):
            text = (
                f"{law} with E = {E:.3g} Pa and {low:.4g} kg/m^3: implausible wave speed {math.sqrt(E / low):.2g} m/s "
            )
            found.append((f"{text}for a metal: is E given in MPa? Steel is E=2.1e11, density=7850", ModelWarning))
        if body.family.solid and nu > MAX_NU:
            text = (
                f"{law} with nu = {nu:.6g}: volumetric locking above {MAX_NU}: use nu=0.49, or refine the mesh until "
            )
            found.append((f"{text}the result is stable", ModelWarning))
        for text, kind in found:
            warnings.warn(f"body {body.name!r}: {text}", kind, stacklevel=4)


def vector(value: Any, what: str) -> np.ndarray:
    """Three finite numbers. ModelError otherwise."""
    try:
        out = np.asarray(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise ModelError(f"{what} = {value!r} is not three numbers") from error
    if out.shape != (3,) or not np.all(np.isfinite(out)):
        hint = f"; write a vector such as (0, 0, {value!r})" if out.shape == () else ""
        raise ModelError(f"{what} = {value!r} is not three finite numbers{hint}")
    return out


def unit_vector(value: Any, what: str) -> np.ndarray:
    """Three finite numbers as a vector of length 1. ModelError otherwise."""
    out = vector(value, what)
    if not np.linalg.norm(out) > 0.0:
        raise ModelError(f"{what} is zero")
    return out / np.linalg.norm(out)


def checked_rotation(rotation: Rotation, what: str) -> Rotation:
    """A rotation with an axis of length 1 and a scalar time law of the angle. ModelError for a bad value."""
    axis, anchor = unit_vector(rotation.axis, f"{what}: axis"), vector(rotation.anchor, f"{what}: anchor")
    return Rotation(anchor, axis, time_law(rotation.angle, f"{what}: angle", scalar=True))


def nodal_vectors(values: Any, nodes: int, what: str) -> np.ndarray:
    """(nodes, 3) from one vector or one per node. ModelError for another shape or values that are not finite."""
    out = np.asarray(values, dtype=float)
    if out.shape == (3,):
        out = np.broadcast_to(out, (nodes, 3))
    if out.shape != (nodes, 3):
        raise ModelError(f"{what} has shape {out.shape}, expected (3,) or {(nodes, 3)}")
    bad = np.flatnonzero(~np.isfinite(out).all(axis=1))
    if len(bad):
        raise ModelError(f"{what}: node {int(bad[0])} has {out[bad[0]].tolist()}")
    return out.copy()


def slot_field(body: Body, values: Any, what: str) -> np.ndarray:
    """A vector field on a body's slots, (slots, 3): values at the nodes, and its gradient on gradient slots.

    Args:
        values: (3,) uniform; a function X (n, 3) -> (n, 3), whose gradient is taken by central
            differences with steps that follow the size of the cells; or (nodes, 3), for bodies without gradient slots.

    Raises:
        ModelError: another shape, values that are not finite, or nodal values on a body with gradient slots.
    """
    X = body.mesh.points
    if callable(values):
        out = nodal_vectors(values(X), len(X), what)[body.slot_node]
        gradient = np.flatnonzero(body.slot_kind > 0)
        if len(gradient):
            node = body.slot_node[gradient]
            step = _node_cell_sizes(body.mesh)[node, None] / 256.0
            at, along = X[node], step * body.reference[gradient]
            moved = {k: nodal_vectors(values(at + k * along), len(at), what) for k in (-2.0, -1.0, 1.0, 2.0)}
            far, near = moved[2.0] - moved[-2.0], moved[1.0] - moved[-1.0]
            out[gradient] = (8.0 * near - far) / (12.0 * step)
        return out
    if body.family.has_gradients and np.shape(values) != (3,):
        raise ModelError(
            f"{what}: body {body.name!r} of element {body.family.name} has gradients at its nodes; give a function "
            "X (n, 3) -> (n, 3), or one vector (3,)"
        )
    return np.where((body.slot_kind == 0)[:, None], nodal_vectors(values, len(X), what)[body.slot_node], 0.0)


def _node_cell_sizes(mesh: Mesh) -> np.ndarray:
    """Extent (m) of the smallest cell at each node (nodes,), 1 for nodes without cells."""
    x = mesh.points[mesh.cells]
    extent = np.max(x.max(axis=1) - x.min(axis=1), axis=1)
    out = np.full(len(mesh.points), np.inf)
    np.minimum.at(out, mesh.cells, np.broadcast_to(extent[:, None], mesh.cells.shape))
    return np.where(np.isfinite(out), out, 1.0)


def component_mask(text: str, what: str) -> np.ndarray:
    """(3,) ones for the letters of "xyz" in the argument."""
    out = np.zeros(3)
    if not isinstance(text, str) or not text or any(c not in COMPONENT_INDEX for c in text):
        raise ModelError(f"{what}: components = {text!r} must be letters of 'xyz'")
    for c in text:
        out[COMPONENT_INDEX[c]] = 1.0
    return out


def assign_materials(name: str, mesh: Mesh, material: Any) -> tuple[list[tuple[str, Material]], np.ndarray]:
    """Laws with the names of their groups, and each element's index into them."""
    if isinstance(material, Material):
        _check_density(name, "", material, mesh)
        return [("", material)], np.zeros(len(mesh.cells), dtype=np.int64)
    if not isinstance(material, dict) or not all(isinstance(m, Material) for m in material.values()):
        hint = "; write wf.SVK(E=2.1e11, nu=0.3, density=7850) or wf.NeoHookean.from_E_nu(...) with numbers of its own"
        raise ModelError(
            f"body {name!r}: material must be a law or a dict of group name to law, got {material!r}{hint}"
        )
    index = np.full(len(mesh.cells), -1, dtype=np.int64)
    for k, (group, law) in enumerate(material.items()):
        if group not in mesh.element_sets:
            raise ModelError(
                f"body {name!r}: material group {group!r} is not an element group of {mesh.label}; there are "
                f"{listing(sorted(mesh.element_sets))}{did_you_mean(group, mesh.element_sets)}"
                f"{_missing_group_hint(mesh)}"
            )
        members = mesh.element_sets[group]
        twice = members[index[members] >= 0]
        if len(twice):
            raise ModelError(f"body {name!r}: element {int(twice[0])} is in two material groups, one of them {group!r}")
        index[members] = k
        _check_density(name, group, law, mesh)
    bare = np.flatnonzero(index < 0)
    if len(bare):
        raise ModelError(
            f"body {name!r}: {len(bare)} elements of {mesh.label} have no material, the first is element "
            f"{int(bare[0])}; groups given: {sorted(material)}"
        )
    return list(material.items()), index


def _missing_group_hint(mesh: Mesh) -> str:
    """Hint for a mesh without element groups."""
    if mesh.element_sets:
        return ""
    names = listing(dict.fromkeys([*mesh.surface_sets, *mesh.node_sets]))
    text = f"; the volume has no group (the groups of surfaces and nodes are {names}): give one material for the whole "
    text += "body, material=law"
    return text if mesh.path is None else text + ', or name the volume in Gmsh, Physical Volume("body") = {1};'


def _check_density(name: str, group: str, material: Any, mesh: Mesh) -> None:
    density: float | np.ndarray | Callable[[np.ndarray], np.ndarray] = material.density
    if callable(density):
        values = np.asarray(density(mesh.points), dtype=float)
        if values.shape != (len(mesh.points),) or not np.all(np.isfinite(values) & (values > 0.0)):
            raise ModelError(f"body {name!r}: density f(X) must give one positive finite value per point")
    elif isinstance(density, np.ndarray) and density.ndim == 1 and len(density) != len(mesh.cells):
        raise ModelError(
            f"body {name!r}: density of group {group!r} has {len(density)} values for {len(mesh.cells)} elements"
        )
