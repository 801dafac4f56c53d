"""Parameters of contacts and colliders per world, for Model.set_parameter."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.worlds import check_values_per_world, values_per_world
from ..model.contacts import Collider, Contact
from ..model.pairs import PairContact
from ..model.shapes import HalfSpace
from .tables import WORLD_PARAMETERS, hunt_crossley_damping, restitution_beta

if TYPE_CHECKING:
    from .collider_tables import ContactTables
    from .facet_tables import PairTables

__all__ = ["collider_parameters", "contact_parameters"]

VALID_RANGES = {  # for error texts
    "mu": "a friction coefficient, 0 or above",
    "mu_static": "at least mu",
    "restitution": "above 0 and at most 1",
    "stiffness": "a positive factor",
    "offset": "a finite number, m",
}


def contact_parameters(tables: ContactTables | PairTables) -> dict[str, Callable[[Any, np.ndarray], None]]:
    """Setters of the parameters of a contact with a collider or of two bodies, by name."""
    out: dict[str, Callable[[Any, np.ndarray], None]] = {}
    for contact in tables.contacts:
        out |= {
            f"{contact.name}.{name}": partial(_set_contact_parameter, tables, contact, name)
            for name in WORLD_PARAMETERS
        }
    return out


def collider_parameters(tables: ContactTables) -> dict[str, Callable[[Any, np.ndarray], None]]:
    """Setters of the parameters of a collider, by name."""
    return {f"{collider.name}.offset": partial(_set_surface_offset, tables, collider) for collider in tables.colliders}


def _set_contact_parameter(
    tables: ContactTables | PairTables, contact: Contact | PairContact, name: str, values: Any, mask: np.ndarray
) -> None:
    """Write one value of a contact in the chosen worlds."""
    what, k, data = f"contact {contact.name!r}", tables.number[contact.index], tables.data
    wanted = values_per_world(what, name, values, tables.model.worlds)
    mu, mu_static = data.mu.numpy()[:, k], data.mu_static.numpy()[:, k]
    check = partial(_check_values, what, name, wanted, ~mask)
    check(np.isfinite(wanted))
    if name == "mu":
        check(wanted >= 0.0)
        follow = mu_static == mu
        high = np.where(follow, np.inf, mu_static)
        check(wanted <= high, "at most mu_static = {:g}", mu_static)
        _write_column(data.mu_static, k, np.where(follow, wanted, mu_static), mask)
    elif name == "mu_static":
        check(wanted >= mu, "at least mu = {:g}", mu)
    elif name == "restitution":
        check((wanted > 0.0) & (wanted <= 1.0))
        wanted = np.where(mask, wanted, 1.0)
        _write_column(data.beta, k, np.array([restitution_beta(float(e)) for e in wanted]), mask)
        wanted = np.array([hunt_crossley_damping(float(e)) for e in wanted])
    else:
        check(wanted > 0.0)
    _write_column(getattr(data, WORLD_PARAMETERS[name]), k, wanted, mask)


def _set_surface_offset(tables: ContactTables, collider: Collider, values: Any, mask: np.ndarray) -> None:
    """Offset the surface of a collider along its normals in the chosen worlds."""
    what = f"collider {collider.name!r}"
    wanted = values_per_world(what, "offset", values, tables.model.worlds)
    _check_values(what, "offset", wanted, ~mask, np.isfinite(wanted))
    if isinstance(collider.shape, HalfSpace):
        wanted = wanted - collider.shape.offset
    _write_column(tables.shapes.margin, tables.colliders.index(collider), wanted, mask)


def _check_values(
    what: str, name: str, values: np.ndarray, left: np.ndarray, good: np.ndarray, text: str = "", limit: Any = None
) -> None:  # fmt: skip
    """Raise ModelError for the first chosen world with an invalid value."""
    for world in np.flatnonzero(~(good | left))[:1]:
        check_values_per_world(
            what, name, values, good | left, text.format(limit[world]) if text else VALID_RANGES[name]
        )


def _write_column(array: wp.array, column: int, values: np.ndarray, mask: np.ndarray) -> None:
    """Write one column of [world, column] in the chosen worlds in place, which captured graphs read."""
    host = array.numpy()
    host[mask, column] = values[mask]
    array.assign(host)
