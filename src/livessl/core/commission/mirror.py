"""Says whether sounds at unknown places leave open that the whole room is mirrored.

Arrays that are reflected in a plane, and with them all sounds, receive the same. If the centres of all arrays lie in
the plane and the reflection of each is nearly the array itself with its channels in another order, a set-up as filed
cannot be told from one whose channels are exchanged at each array: every place is then on the wrong side of the plane.
"""

from __future__ import annotations

from itertools import combinations, permutations
from typing import Final

import numpy as np

from livessl.core.commission.blind_spot import BlindSpot
from livessl.core.commission.places import Microphones
from livessl.core.types import FloatArray, IntArray

MOST_TURN_DEG: Final = 25.0
"""Largest turn of an array, in degrees, by which a reflection may differ from the filed set-up: people file poses that
are further off less often than they exchange channels."""

SAME_M: Final = 0.02
"""Distance, in metres, within which microphones are at the same place, and centres in one plane."""

BEYOND_M: Final = 0.3
"""Distance, in metres, by which a place may be outside the search volume: places of single sounds have errors."""

ALL_ORDERS: Final = 5
"""Most microphones of an array of which all orders are tried; of larger ones only exchanges of two."""

PLANES: Final = 180
"""Number of planes that are tried through arrays on one line."""


def mirrored(microphones: Microphones, places_m: FloatArray, bounds_m: FloatArray) -> BlindSpot | None:
    """Return that the room may be mirrored, or None where that is excluded or needs too large turns of the arrays.

    Parameters
    ----------
    microphones : mapping of array to (K, 3) float64
        As filed, metres.
    places_m : (S, 3) float64
        Places of the sounds in the filed set-up, metres.
    bounds_m : (3, 2) float64
        Search volume, metres: a place that is mirrored to somewhere outside excludes the reflection.

    Returns
    -------
    BlindSpot or None
        Of the reflection that needs the smallest turns; `least` is the largest of these, and `along` the normal of the
        plane. An array on one line has no order that a reflection changes, so with one there is None.
    """
    spans = [np.linalg.svd(at_m - at_m.mean(axis=0), compute_uv=False) for at_m in microphones.values()]
    if any(len(span) < 2 or span[1] < SAME_M for span in spans):
        return None
    centres_m = np.array([at_m.mean(axis=0) for at_m in microphones.values()])
    middle_m, normals = centres_m.mean(axis=0), _normals(centres_m)
    if len(normals) == 0:
        return None
    turns_deg = np.zeros(len(normals))
    changed = np.zeros(len(normals), dtype=bool)
    for at_m in microphones.values():
        turn_deg, order = _turns(at_m, normals)
        turns_deg = np.maximum(turns_deg, turn_deg)
        changed |= order > 0
    heights_m = (places_m - middle_m) @ normals.T
    mirrored_m = places_m[:, None] - 2.0 * heights_m[..., None] * normals
    beyond_m = np.maximum(bounds_m[:, 0] - mirrored_m, mirrored_m - bounds_m[:, 1])
    possible = changed & (beyond_m <= BEYOND_M).all(axis=(0, 2))
    turns_deg[~possible] = np.inf
    best = int(turns_deg.argmin())
    if turns_deg[best] > MOST_TURN_DEG:
        return None
    normal = normals[best] * np.sign(normals[best][np.abs(normals[best]).argmax()])
    return BlindSpot("mirrored", tuple(microphones), float(turns_deg[best]), tuple(normal.tolist()))


def _normals(centres_m: FloatArray) -> FloatArray:
    """Return unit normals (N, 3) of planes that all centres (A, 3) lie in; none if there is no such plane."""
    apart_m = centres_m - centres_m.mean(axis=0)
    axes = np.linalg.svd(apart_m)[2]
    flat = axes[(np.abs(apart_m @ axes.T) <= SAME_M).all(axis=0)]
    if len(flat) != 2:  # all directions across a line, or the one across a plane
        return flat if len(flat) == 1 else np.empty((0, 3))
    angles = np.linspace(0.0, np.pi, PLANES, endpoint=False)
    return np.asarray(np.cos(angles)[:, None] * flat[0] + np.sin(angles)[:, None] * flat[1])


def _turns(at_m: FloatArray, normals: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the least turn, in degrees, that brings an array to its reflections, and with which order of its channels.

    Infinity where no order does; order 0 is the filed one, which is preferred.
    """
    own_m = at_m - at_m.mean(axis=0)
    orders = _orders(len(own_m))
    ordered_m = own_m[orders]  # (P, K, 3)
    reflected_m = own_m - 2.0 * (own_m @ normals.T).T[..., None] * normals[:, None]  # (N, K, 3)
    left, sizes, right = np.linalg.svd(np.einsum("pki,nkj->npij", ordered_m, reflected_m))
    handedness = np.sign(np.linalg.det(left) * np.linalg.det(right))
    sizes[..., 2] *= handedness
    squares_m2 = 2.0 * (own_m**2).sum() - 2.0 * sizes.sum(axis=-1)
    left[..., :, 2] *= handedness[..., None]
    traces = np.einsum("npij,npji->np", left, right)
    turns_deg = np.degrees(np.arccos(np.clip((traces - 1.0) / 2.0, -1.0, 1.0)))
    turns_deg[squares_m2 > len(own_m) * SAME_M**2] = np.inf
    order = turns_deg.argmin(axis=1)
    return turns_deg[np.arange(len(normals)), order], order


def _orders(count: int) -> IntArray:
    """Return orders of channels (P, K), the filed one first."""
    if count <= ALL_ORDERS:
        return np.array(list(permutations(range(count))))
    orders = [np.arange(count)]
    for one, other in combinations(range(count), 2):
        exchanged = np.arange(count)
        exchanged[[one, other]] = other, one
        orders.append(exchanged)
    return np.array(orders)
