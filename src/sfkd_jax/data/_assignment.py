"""Assign segments of recorded drives to training, validation, calibration and test."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sfkd_jax.data._splits import check_shares

ATTEMPTS = 200
"""Orders of the drives that are tried before drives are cut."""
TOLERANCE = 2.0
"""A part may be this many times larger or smaller than its share."""


class Assignment(NamedTuple):
    """The part of every segment.

    Attributes:
        parts: number of the part, in the order of `PARTS`.
        whole: whether every drive is in one part only.
    """

    parts: Int[np.ndarray, " segment"]
    whole: bool


def assign_parts(
    drives: Int[np.ndarray, " segment"], *, shares: tuple[float, ...], seed: int
) -> Assignment:
    """Assign whole drives at random if the parts come near their shares.

    Otherwise cut each drive into four stretches of time. Parts made of whole drives
    share no drive. Parts made of stretches are neighbours in time, and what is measured
    on them holds for more of the same drives, not for new ones.

    Args:
        drives: number of the drive of every segment.
        shares: of the parts.
        seed: of the random order of drives.

    Raises:
        ValueError: shares that are not four positive numbers of sum 1, or too few
            segments for them.
    """
    check_shares(shares)
    whole = _whole_drives(drives, np.asarray(shares), seed)
    if whole is not None:
        return Assignment(whole, whole=True)
    sizes = np.unique(drives, return_counts=True)[1]
    order = np.concatenate([(np.arange(size) + 0.5) / size for size in sizes])
    parts = np.empty(len(drives), dtype=int)
    parts[np.argsort(drives, kind="stable")] = np.searchsorted(
        np.cumsum(shares)[:-1], order
    )
    if len(np.unique(parts)) < len(shares):
        raise ValueError(
            f"{len(drives)} segments are too few for "
            f"dataset.shares={list(shares)}; record more"
        )
    return Assignment(parts, whole=False)


def _whole_drives(
    drives: Int[np.ndarray, " segment"], shares: Float[np.ndarray, " part"], seed: int
) -> Int[np.ndarray, " segment"] | None:
    """Parts made of whole drives; None if no attempt comes near the shares."""
    names, sizes = np.unique(drives, return_counts=True)
    if len(names) < len(shares):
        return None
    random = np.random.default_rng(seed)
    for _ in range(ATTEMPTS):
        owner = _distribute(sizes, shares, random.permutation(len(names)))
        reached = np.bincount(owner, weights=sizes, minlength=len(shares))
        relative = reached / len(drives) / shares
        if relative.min() >= 1 / TOLERANCE and relative.max() <= TOLERANCE:
            return owner[np.searchsorted(names, drives)]
    return None


def _distribute(
    sizes: Int[np.ndarray, " drive"],
    shares: Float[np.ndarray, " part"],
    order: Int[np.ndarray, " drive"],
) -> Int[np.ndarray, " drive"]:
    """Give each drive in turn to the part that lacks most of its share."""
    lacking, owner = shares * sizes.sum(), np.empty(len(sizes), dtype=int)
    for drive in order:
        owner[drive] = lacking.argmax()
        lacking[owner[drive]] -= sizes[drive]
    return owner
