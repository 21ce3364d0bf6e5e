"""Segments of logged drives dealt to training, validation, calibration and test."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from sfkd_jax.datasets._splits import check_shares

ATTEMPTS = 200
"""Orders of the drives that are tried before drives are cut."""
TOLERANCE = 2.0
"""A part may be this many times larger or smaller than its share."""


class Deal(NamedTuple):
    """Which of the four parts each segment goes to, and whether every drive is in one part only."""

    parts: Int[np.ndarray, " segment"]
    whole: bool


def deal(
    drives: Int[np.ndarray, " segment"], *, shares: tuple[float, ...], seed: int
) -> Deal:
    """Deal whole drives, at random, if that comes near the shares; else cut each drive into four stretches of time.

    Drives dealt whole leave nothing of a test or calibration drive in training. Where
    there are too few, the parts are neighbours in time, and what is counted on them
    holds for more of the same drives, not for new ones.

    Raises:
        ValueError: shares that are not four positive numbers of sum 1, or too few
            segments for them.
    """
    check_shares(shares)
    names, sizes = np.unique(drives, return_counts=True)
    random = np.random.default_rng(seed)
    for _ in range(ATTEMPTS if len(names) >= len(shares) else 0):
        owner = _hand_out(sizes, np.asarray(shares), random.permutation(len(names)))
        got = (
            np.bincount(owner, weights=sizes, minlength=len(shares))
            / len(drives)
            / shares
        )
        if got.min() >= 1 / TOLERANCE and got.max() <= TOLERANCE:
            return Deal(owner[np.searchsorted(names, drives)], whole=True)
    order = np.concatenate([(np.arange(size) + 0.5) / size for size in sizes])
    parts = np.empty(len(drives), dtype=int)
    parts[np.argsort(drives, kind="stable")] = np.searchsorted(
        np.cumsum(shares)[:-1], order
    )
    if len(np.unique(parts)) < len(shares):
        raise ValueError(
            f"{len(drives)} segments are too few for dataset.shares={list(shares)}; record more"
        )
    return Deal(parts, whole=False)


def _hand_out(
    sizes: Int[np.ndarray, " drive"],
    shares: np.ndarray,
    order: Int[np.ndarray, " drive"],
) -> Int[np.ndarray, " drive"]:
    """Each drive in turn to the part that lacks most of its share."""
    lacking, owner = shares * sizes.sum(), np.empty(len(sizes), dtype=int)
    for drive in order:
        owner[drive] = lacking.argmax()
        lacking[owner[drive]] -= sizes[drive]
    return owner
