"""What Model.set_parameter sets of contacts and colliders, in each world."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.errors import ModelError
from ..model.contacts import Collider, Contact
from ..model.pairs import PairContact
from ..model.shapes import HalfSpace
from .facet_tables import PER_WORLD, beta_of, hunt_crossley_damping

if TYPE_CHECKING:
    from .contact_tables import ContactTables
    from .pair_tables import PairTables

__all__ = ["collider_parameters", "contact_parameters"]

WANTED = {
    "mu": "a friction coefficient, 0 or above",
    "mu_static": "at least mu",
    "restitution": "above 0 and at most 1",
    "stiffness": "a positive factor",
    "offset": "a finite number, m",
}


def contact_parameters(tables: ContactTables | PairTables) -> dict[str, Callable[[Any], None]]:
    """What sets a parameter of a contact with a collider or of two bodies, by its name."""
    out: dict[str, Callable[[Any], None]] = {}
    for contact in tables.contacts:
        out |= {f"{contact.name}.{name}": partial(_set_contact, tables, contact, name) for name in PER_WORLD}
    return out


def collider_parameters(tables: ContactTables) -> dict[str, Callable[[Any], None]]:
    """What sets a parameter of a collider, by its name."""
    return {f"{collider.name}.offset": partial(_set_offset, tables, collider) for collider in tables.colliders}


def _set_contact(
    tables: ContactTables | PairTables, contact: Contact | PairContact, name: str, values: Any
) -> None:  # fmt: skip
    """Write a value of a contact in all worlds."""
    what, k, data = f"contact {contact.name!r}", tables.number[contact.index], tables.data
    wanted = _per_world(what, name, values, tables.model.worlds)
    mu, mu_static = data.mu.numpy()[:, k], data.mu_static.numpy()[:, k]
    if name == "mu":
        _check(what, name, wanted, wanted >= 0.0)
        follow = mu_static == mu
        high = np.where(follow, np.inf, mu_static)
        _check(what, name, wanted, wanted <= high, "at most mu_static = {:g}", mu_static)
        _write(data.mu_static, k, np.where(follow, wanted, mu_static))
    elif name == "mu_static":
        _check(what, name, wanted, wanted >= mu, "at least mu = {:g}", mu)
    elif name == "restitution":
        _check(what, name, wanted, (wanted > 0.0) & (wanted <= 1.0))
        _write(data.beta, k, np.array([beta_of(float(e)) for e in wanted]))
        wanted = np.array([hunt_crossley_damping(float(e)) for e in wanted])
    else:
        _check(what, name, wanted, wanted > 0.0)
    _write(getattr(data, PER_WORLD[name]), k, wanted)


def _set_offset(tables: ContactTables, collider: Collider, values: Any) -> None:
    """Move the surface of a collider along its normals."""
    wanted = _per_world(f"collider {collider.name!r}", "offset", values, tables.model.worlds)
    if isinstance(collider.shape, HalfSpace):
        wanted = wanted - collider.shape.offset
    _write(tables.data.grow, tables.colliders.index(collider), wanted)


def _per_world(what: str, name: str, values: Any, worlds: int) -> np.ndarray:
    """(worlds,) finite numbers of a number or an array on the host or on a device."""
    try:
        out = np.asarray(values.numpy() if isinstance(values, wp.array) else values, dtype=float)
    except (TypeError, ValueError):
        raise ModelError(f"{what}: {name} = {values!r} must be a number, or one per world") from None
    if out.shape not in ((), (worlds,)):
        raise ModelError(f"{what}: {name} has shape {out.shape}, expected a number or ({worlds},), one per world")
    out = np.broadcast_to(out, (worlds,)).astype(float)
    _check(what, name, out, np.isfinite(out))
    return out


def _check(
    what: str, name: str, values: np.ndarray, good: np.ndarray, text: str | None = None, limit: Any = None
) -> None:  # fmt: skip
    """Raise ModelError for the first world whose value is not good."""
    for world in np.flatnonzero(~good)[:1]:
        wanted = WANTED[name] if text is None else text.format(limit[world])
        raise ModelError(f"{what}: {name} = {float(values[world])!r} in world {world} must be {wanted}")


def _write(array: wp.array, column: int, values: np.ndarray) -> None:
    """Put values (worlds,) into a column of an array [world, column], in place: recorded graphs see them."""
    host = array.numpy()
    host[:, column] = values
    array.assign(host)
