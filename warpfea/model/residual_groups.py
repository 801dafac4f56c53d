"""Groups of slots whose residuals are judged apart: what is joined, by materials of like stiffness."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

__all__ = ["SlotGroups", "slot_groups"]

LIKE = 10.0
"""Shear moduli that differ by less than this factor, one from the next, are of like stiffness."""


def stiffness_classes(mu: np.ndarray, label: np.ndarray) -> np.ndarray:
    """(n,) number, from 0 for the softest, of the class of like shear moduli `mu` (n,), Pa, within each `label`."""
    out = np.zeros(len(mu), dtype=np.int64)
    for one in np.unique(label):
        values, which = np.unique(mu[label == one], return_inverse=True)
        out[label == one] = np.append(0, np.cumsum(values[1:] > LIKE * values[:-1]))[which.ravel()]
    return out


def like_stiffness(model: Any) -> tuple[np.ndarray, np.ndarray]:
    """Class of stiffness in its component, of each slot and of each element in the order of the model's blocks.

    A slot between materials is one of the stiffest there, which its forces come from; an element belongs with the
    softest of its slots. Moduli are those that the model was built with.
    """
    parts = [host for block in model.blocks for host in block.parts]
    component = np.concatenate([model.component[host.conn[:, 0] + host.body.slot_offset] for host in parts])
    mu = np.concatenate([np.full(len(host.conn), host.body.materials[host.material][1].lame[1]) for host in parts])
    of_element = stiffness_classes(mu, component)
    of_slot = np.zeros(model.slots, dtype=np.int64)
    connectivity = [block.connectivity for block in model.blocks]
    ends = np.cumsum([len(conn) for conn in connectivity])[:-1]
    for conn, classes in zip(connectivity, np.split(of_element, ends)):
        np.maximum.at(of_slot, conn, classes[:, None])
    return of_slot, np.concatenate([of_slot[conn].min(axis=1) for conn in connectivity])


@dataclass(frozen=True)
class SlotGroups:
    """Slots and elements by group, on the device; with one group the lists are empty and stand for all in order.

    Attributes:
        slot_start, element_start: [group + 1] into slot and element.
        component: [group] connected component of the model.
    """

    count: int
    slot_start: wp.array
    slot: wp.array
    element_start: wp.array
    element: wp.array
    component: wp.array


def slot_groups(model: Any, label: np.ndarray) -> SlotGroups:
    """Groups of one `label` (slots,), each of whose elements has one, and of one class of stiffness."""
    of_slot, of_element = like_stiffness(model)
    first = np.concatenate([block.connectivity[:, 0] for block in model.blocks])
    keys, of = np.unique(label * (of_slot.max() + 1) + of_slot, return_inverse=True)
    of_element = np.searchsorted(keys, label[first] * (of_slot.max() + 1) + of_element)

    def listed(of: np.ndarray) -> tuple[wp.array, wp.array]:
        edges = np.concatenate([[0], np.cumsum(np.bincount(of, minlength=len(keys)))])
        order = np.argsort(of, kind="stable") if len(keys) > 1 else np.zeros(0)
        return model.array("components", edges, wp.int32), model.array("components", order, wp.int32)

    component = np.zeros(len(keys))
    component[of.ravel()] = model.component
    return SlotGroups(
        len(keys), *listed(of.ravel()), *listed(of_element), model.array("components", component, wp.int32)
    )
