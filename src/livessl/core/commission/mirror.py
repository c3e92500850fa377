"""Decides whether the whole room may be mirrored, which sounds at unknown places cannot exclude.

Mirror images of a single sound are in `core/mirror.py`.

If all arrays and all sounds are reflected in a plane, the arrays receive the same signals. Assume that the centres of
all arrays lie in the plane, and that the reflection of each array is nearly the array itself with its channels in
another order. The filed set-up then cannot be distinguished from one in which the channels of each array are exchanged,
so every position may be on the wrong side of the plane.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from typing import Final

import numpy as np
from scipy.spatial.distance import pdist, squareform

from livessl.core.commission.blind_spot import BlindSpot
from livessl.core.commission.places import Microphones
from livessl.core.types import BoolArray, FloatArray

MOST_TURN_DEG: Final = 25.0
"""Largest rotation of an array, in degrees, by which a reflection may differ from the filed set-up. Larger errors of
poses are less common than exchanged channels."""

SAME_M: Final = 0.02
"""Distance, in metres, up to which centres count as being in one plane, and microphones as being at the same place. In
small arrays it is a third of the least distance between microphones, so that neighbours are not confused."""

BEYOND_M: Final = 0.3
"""Largest distance, in metres, of a place from the search volume, because places of single sounds have errors."""

MOST_ORDERS: Final = 100
"""Largest number of orders of an array's channels that are tried. A cube of eight microphones has 48 orders that keep
all distances."""

PLANES: Final = 180
"""Number of planes that are tried through arrays on one line."""


def mirrored(microphones: Microphones, places_m: FloatArray, bounds_m: FloatArray) -> BlindSpot | None:
    """Return a blind spot if the room may be mirrored; None if that is excluded or needs large rotations of the arrays.

    Parameters
    ----------
    microphones : mapping of array to (K, 3) float64
        As filed, metres.
    places_m : (S, 3) float64
        Places of the sounds in the filed set-up, metres.
    bounds_m : (3, 2) float64
        Search volume, metres. A place whose mirror image is outside excludes the reflection.

    Returns
    -------
    BlindSpot or None
        Blind spot of the reflection with the smallest rotations: the arrays whose channels are exchanged, the largest
        rotation as `least`, and the normal of the plane as `along`. None if an array lies on one line, because its
        reflection is a rotation. None if no array needs exchanged channels, because the geometry alone then reveals it.
    """
    if any(_is_line(at_m) for at_m in microphones.values()):
        return None
    centres_m = np.array([at_m.mean(axis=0) for at_m in microphones.values()])
    normals = _normals(centres_m)
    normals = normals[_are_inside(places_m, centres_m.mean(axis=0), normals, bounds_m)]
    if len(normals) == 0:
        return None
    turns_deg, changed = np.zeros(len(normals)), {}
    for name, at_m in microphones.items():
        turn_deg, changed[name] = _turns(at_m, normals)
        turns_deg = np.maximum(turns_deg, turn_deg)
    turns_deg[~np.any(list(changed.values()), axis=0)] = np.inf
    best = int(turns_deg.argmin())
    if turns_deg[best] > MOST_TURN_DEG:
        return None
    normal = normals[best] * np.sign(normals[best][np.abs(normals[best]).argmax()])
    exchanged = tuple(name for name, one in changed.items() if one[best])
    return BlindSpot("mirrored", exchanged, float(turns_deg[best]), tuple(normal.tolist()))


def _is_line(at_m: FloatArray) -> bool:
    spans = np.linalg.svd(at_m - at_m.mean(axis=0), compute_uv=False)
    return len(spans) < 2 or bool(spans[1] < SAME_M)


def _are_inside(places_m: FloatArray, middle_m: FloatArray, normals: FloatArray, bounds_m: FloatArray) -> BoolArray:
    """Return for each plane whether the mirror images of all places (S, 3) are inside the search volume."""
    heights_m = (places_m - middle_m) @ normals.T
    mirrored_m = places_m[:, None] - 2.0 * heights_m[..., None] * normals
    beyond_m = np.maximum(bounds_m[:, 0] - mirrored_m, mirrored_m - bounds_m[:, 1])
    return np.asarray((beyond_m <= BEYOND_M).all(axis=(0, 2)))


def _normals(centres_m: FloatArray) -> FloatArray:
    """Return the unit normals (N, 3) of the planes that contain all centres (A, 3); none if there is no such plane."""
    apart_m = centres_m - centres_m.mean(axis=0)
    axes = np.linalg.svd(apart_m)[2]
    flat = axes[(np.abs(apart_m @ axes.T) <= SAME_M).all(axis=0)]
    if len(flat) != 2:  # all directions across a line, or the one across a plane
        return flat if len(flat) == 1 else np.empty((0, 3))
    angles = np.linspace(0.0, np.pi, PLANES, endpoint=False)
    return np.asarray(np.cos(angles)[:, None] * flat[0] + np.sin(angles)[:, None] * flat[1])


def _turns(at_m: FloatArray, normals: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the least rotation, in degrees, between an array and each reflection, and whether channels are exchanged.

    The rotation is infinite if no order of the channels fits. The filed order is preferred if its rotation is small
    enough.
    """
    own_m = at_m - at_m.mean(axis=0)
    apart_m = squareform(pdist(own_m))
    same_m = min(SAME_M, float(pdist(own_m).min()) / 3.0)
    are_alike = np.abs(apart_m[:, :, None, None] - apart_m) <= 2.0 * same_m
    orders = np.array(list(islice(_orders(are_alike, ()), MOST_ORDERS)))
    ordered_m = own_m[orders]  # (P, K, 3)
    reflected_m = own_m - 2.0 * (own_m @ normals.T).T[..., None] * normals[:, None]  # (N, K, 3)
    left, sizes, right = np.linalg.svd(np.einsum("pki,nkj->npij", ordered_m, reflected_m))
    handedness = np.sign(np.linalg.det(left) * np.linalg.det(right))
    sizes[..., 2] *= handedness
    squares_m2 = 2.0 * (own_m**2).sum() - 2.0 * sizes.sum(axis=-1)
    left[..., :, 2] *= handedness[..., None]
    traces = np.einsum("npij,npji->np", left, right)
    turns_deg = np.degrees(np.arccos(np.clip((traces - 1.0) / 2.0, -1.0, 1.0)))
    turns_deg[squares_m2 > len(own_m) * same_m**2] = np.inf
    filed_deg, least_deg = turns_deg[:, 0], turns_deg.min(axis=1)
    is_filed = filed_deg <= MOST_TURN_DEG
    return np.where(is_filed, filed_deg, least_deg), ~is_filed


def _orders(are_alike: BoolArray, begun: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    """Yield the orders of channels that begin with `begun` and keep all distances, the filed order first.

    `are_alike` (K, K, K, K) is True if the distance between two microphones equals that between two others.
    """
    index = len(begun)
    if index == len(are_alike):
        yield begun
        return
    able = are_alike[index, range(index), :, begun].all(axis=0)
    for other in np.flatnonzero(able).tolist():
        if other not in begun:
            yield from _orders(are_alike, (*begun, other))
