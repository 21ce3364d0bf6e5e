"""Benchmarks: run one with `python -m benchmarks.NAME` from the repository."""

import argparse
import json


def arguments(about, **defaults):
    """Options with their defaults; of a tuple or a dictionary, any of its entries."""
    parser = argparse.ArgumentParser(
        description=about, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, value in defaults.items():
        kind = {"type": type(value), "default": value}
        if isinstance(value, tuple | dict):
            kind = {"nargs": "*", "choices": value, "default": [*value]}
        elif isinstance(value, list):
            kind |= {"nargs": "*", "type": type(value[0])}
        parser.add_argument(f"--{name}", **kind)
    return parser.parse_args()


def write(path, head, rows):
    """One line a row, so that a change of one row is a change of one line."""
    compact = {"ensure_ascii": False, "separators": (",", ":")}
    lines = ",\n".join(json.dumps(row, **compact) for row in rows)
    text = f'{json.dumps(head)[:-1]}, "rows": [\n{lines}\n]}}\n'
    path.write_text(text, "utf-8")
