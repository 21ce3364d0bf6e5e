"""Benchmarks: run one with `python -m benchmarks.NAME` from the repository."""

import argparse
import hashlib
import json
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
PRETRAINED = ROOT / "src" / "sfkd_jax" / "pretrained"
GOLDENS = ROOT / "tests" / "goldens" / "controls.npz"
"""Controls that a test holds the code to: as long as they stay, the code drives the same."""


def digest(file):
    """The first 12 hexadecimal digits of the SHA-256 of a file."""
    return hashlib.sha256(file.read_bytes()).hexdigest()[:12]


def stamp(policy=None):
    """With which code and weights a row is driven now: the fields that name both.

    `controls` is the digest of the goldens. It changes when the code drives otherwise, and
    stays when the code is only written otherwise. `weights` is the digest of the shipped
    policy that drives; a row whose model was trained for that row has none.

    Args:
        policy: name of the policy that ships with the package, if one drives.
    """
    fields = {"controls": digest(GOLDENS)}
    if policy is not None:
        fields["weights"] = digest(PRETRAINED / policy / "policy.safetensors")
    return fields


def is_old(row, policy=None):
    """Whether other code or weights drove a row than what ships, or nobody noted which."""
    return any(row.get(name) != value for name, value in stamp(policy).items())


def arguments(about, file, **defaults):
    """Options with their defaults; of a tuple or a dictionary, any of its entries.

    Args:
        about: text of the help.
        file: of the benchmark. The option `out` is by default the JSON beside it.
        defaults: of the other options. A list takes several values of its type.
    """
    parser = argparse.ArgumentParser(
        description=about, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    defaults["out"] = Path(file).with_suffix(".json")
    for name, value in defaults.items():
        if isinstance(value, tuple | dict):
            kind = {"nargs": "*", "choices": value, "default": [*value]}
        elif isinstance(value, list):
            kind = {"nargs": "*", "type": type(value[0]), "default": value}
        else:
            kind = {"type": type(value), "default": value}
        parser.add_argument(f"--{name}", **kind)
    return parser.parse_args()


def write(path, head, rows):
    """Write a JSON document: the fields of the head, then the rows, one line a row."""
    path.write_text(f'{json.dumps(head)[:-1]}, "rows": {as_lines(rows)}}}\n', "utf-8")


def as_lines(rows):
    """Rows as a JSON list, one line a row: a change of one row is a change of one line."""
    compact = {"ensure_ascii": False, "separators": (",", ":")}
    lines = ",\n".join(json.dumps(row, **compact) for row in rows)
    return f"[\n{lines}\n]"


def search(draw, size, generations, reward):
    """Cross-entropy search for genes with a large reward.

    Args:
        draw: a NumPy generator.
        size: (runs of a generation, genes of a run).
        generations: how often the distribution is fitted to the best tenth.
        reward: (run, gene) -> reward of every run. It keeps what it found.
    """
    runs, genes_of_a_run = size
    mean = np.zeros(genes_of_a_run)
    spread = 1.0
    for _ in range(generations):
        genes = mean + spread * draw.normal(size=size)
        best_last = np.argsort(reward(genes))
        elite = genes[best_last[-max(2, runs // 10) :]]
        mean = elite.mean(axis=0)
        spread = np.maximum(elite.std(axis=0), 0.1)


def total(found):
    """The last of the rows of a search, with the counts summed over all of them."""
    counts = [name for name, value in found[0].items() if type(value) is int]
    return found[-1] | {name: sum(one[name] for one in found) for name in counts}
