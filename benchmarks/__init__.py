"""Benchmarks: run one with `python -m benchmarks.NAME` from the repository."""

import argparse
import json
from pathlib import Path

import numpy as np


def arguments(about, file, **defaults):
    """Options with their defaults; of a tuple or a dictionary, any of its entries.

    `out` is by default the JSON beside the file of the benchmark.
    """
    parser = argparse.ArgumentParser(
        description=about, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, value in (defaults | {"out": Path(file).with_suffix(".json")}).items():
        kind = {"type": type(value), "default": value}
        if isinstance(value, tuple | dict):
            kind = {"nargs": "*", "choices": value, "default": [*value]}
        elif isinstance(value, list):
            kind |= {"nargs": "*", "type": type(value[0])}
        parser.add_argument(f"--{name}", **kind)
    return parser.parse_args()


def write(path, head, rows):
    """A head and rows as JSON."""
    path.write_text(f'{json.dumps(head)[:-1]}, "rows": {as_lines(rows)}}}\n', "utf-8")


def as_lines(rows):
    """One line a row, so that a change of one row is a change of one line."""
    compact = {"ensure_ascii": False, "separators": (",", ":")}
    lines = ",\n".join(json.dumps(row, **compact) for row in rows)
    return f"[\n{lines}\n]"


def search(draw, size, generations, reward):
    """Cross-entropy search over genes of `size` = (run, gene) for the largest reward."""
    mean, spread = np.zeros(size[1]), 1.0
    for _ in range(generations):
        genes = mean + spread * draw.normal(size=size)
        elite = genes[np.argsort(reward(genes))[-max(2, size[0] // 10) :]]
        mean, spread = elite.mean(axis=0), np.maximum(elite.std(axis=0), 0.1)


def total(found):
    """The last of the rows of a search, with the counts of all of them."""
    counts = [name for name, value in found[0].items() if type(value) is int]
    return found[-1] | {name: sum(one[name] for one in found) for name in counts}
