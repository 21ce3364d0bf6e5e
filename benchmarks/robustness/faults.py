"""Faults of what a controller is given, drawn ahead of a drive: when, for how long, and what the readings become.

A fault is a lag and an offset: a reading becomes what it was `lag` steps before, plus
`offset`, which may be NaN, infinite or huge. A frozen reading is one whose lag grows by
one at every step.
"""

from typing import NamedTuple

import numpy as np

KINDS = (
    "nan",
    "infinite",
    "huge",
    "frozen",
    "jump",
    "delayed",
    "outside",
    "alternating",
    "clock",
)
CHANNELS = ("observation", "env", "reference")
DURATION = (1, 30)
"""Steps that a fault lasts, drawn evenly."""
PAUSE = (100, 200)
"""Steps without a fault after it."""
LAGS = (1, 10)
"""Steps by which delayed readings are late."""
JUMPS = {
    "observation": (5.0, 5.0, 1.0, 3.0, 1.0, 0.5, 0.2),
    "env": (0.5, 8.0),
    "reference": (5.0, 5.0, 1.0, 3.0),
}
"""What each entry jumps by, in its own units."""
OUTSIDE = {
    "observation": (0.0, 0.0, 0.0, 30.0, 20.0, 5.0, 2.0),
    "env": (2.0, 40.0),
    "reference": (0.0, 0.0, 0.0, 30.0),
}
"""What takes each entry out of its box."""
CLOCK = (np.nan, np.inf, -np.inf, -3.0, 0.0, 0.4, 2.7, 1e9)
"""Sampling periods since the last call, as told by a clock that fails."""


class Faults(NamedTuple):
    """What is wrong at each step; time is the leading axis.

    Attributes:
        kind: index into KINDS, -1 without a fault.
        lag: steps, (time, channel).
        offset: per channel, each (time, entry).
        elapsed: sampling periods since the last call, as told.
    """

    kind: np.ndarray
    lag: np.ndarray
    offset: tuple[np.ndarray, ...]
    elapsed: np.ndarray


def draw(random, steps, sizes):
    """Faults with pauses between them, for readings of `sizes` entries, by channel;
    none at all without `random`.
    """
    kind, elapsed = np.full(steps, -1, np.int32), np.ones(steps, np.float32)
    lag = np.zeros((steps, len(sizes)), np.int32)
    offset = tuple(np.zeros((steps, size), np.float32) for size in sizes)
    start = random.integers(*PAUSE, endpoint=True) if random else steps
    while start < steps:
        end = min(start + random.integers(*DURATION, endpoint=True), steps)
        during = slice(start, end)
        kind[during] = random.integers(len(KINDS))
        name = KINDS[kind[start]]
        if name == "clock":
            elapsed[during] = random.choice(CLOCK, end - start)
        else:
            everything = random.random() < 0.25
            chosen = range(len(sizes)) if everything else [random.integers(len(sizes))]
            for channel in chosen:
                fault = _fault(
                    random, name, end - start, CHANNELS[channel], sizes[channel]
                )
                lag[during, channel], offset[channel][during] = fault
        start = end + random.integers(*PAUSE, endpoint=True)
    return Faults(kind, lag, offset, elapsed)


def _fault(random, name, steps, channel, size):
    """Lag (steps,) and offset (steps, size) of one fault of one channel; it hits at
    least one entry.
    """
    hit = random.random(size) < 0.5
    hit[random.integers(size)] = True
    sign = random.choice((-1.0, 1.0), size)
    lag, offset = np.zeros(steps, np.int32), np.zeros((steps, size), np.float32)
    if name == "frozen":
        lag = np.arange(1, steps + 1)
    elif name == "delayed":
        lag[:] = random.integers(*LAGS, endpoint=True)
    elif name == "nan":
        offset[:, hit] = np.nan
    elif name == "infinite":
        offset[:, hit] = sign[hit] * np.inf
    elif name == "huge":
        offset[:, hit] = sign[hit] * 10.0 ** random.uniform(4, 38)
    elif name == "outside":
        offset[:, hit] = sign[hit] * np.asarray(OUTSIDE[channel])[:size][hit]
    else:
        offset[:, hit] = sign[hit] * np.asarray(JUMPS[channel])[:size][hit]
        if name == "alternating":  # right, missing and displaced in turn
            offset[0::3], offset[1::3, hit] = 0.0, np.nan
    return lag, offset
