"""Write the defaults of the Python signatures into the files of options.

`python -m sfkd_jax.experiment.option_files` does so for every file of `conf/` that
begins with a schema. A line that it wrote ends in `# default`, followed by the range of
the value. Whoever chooses another value removes that mark; the rest of a file is never
changed. A test fails where a file and its signatures differ.
"""

from __future__ import annotations

import dataclasses
import math
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from sfkd_jax.experiment.command import conf_path
from sfkd_jax.experiment.schemas import SCHEMAS
from sfkd_jax.ranges import Interval
from sfkd_jax.settings import OneOf
from sfkd_jax.store import plain, print_message, write_bytes

MARK = "  # default"
"""What a line ends in, before a range, if its value is that of a signature."""


def files() -> dict[Path, type]:
    """Return the dataclass of each file of options that begins with a schema."""
    found = {}
    for path in sorted(Path(conf_path()).glob("*/*.yaml")):
        options = yaml.safe_load(path.read_text("utf-8"))
        for entry in options.get("defaults", []):
            if isinstance(entry, str) and (path.parent.name, entry) in SCHEMAS:
                found[path] = SCHEMAS[path.parent.name, entry]
    return found


def with_defaults(text: str, schema: type) -> str:
    """Return the text of a file of options with a line for every default.

    Args:
        text: of the file.
        schema: the dataclass of its settings.
    """
    kept = [line for line in text.splitlines() if MARK not in line]
    chosen = yaml.safe_load("\n".join(kept)) or {}
    groups = {
        name: hint
        for name, hint in typing.get_type_hints(schema).items()
        if dataclasses.is_dataclass(hint)
    }
    lines: list[str] = []
    group = None
    for line in kept:
        if group and not line.startswith(" "):
            lines.extend(_missing(groups[group], chosen[group], indent="  "))
            group = None
        # The defaults of a group of which some values are chosen follow these.
        name = line.partition(":")[0]
        if name in groups:
            group = name
        lines.append(line)
    if group:
        lines.extend(_missing(groups[group], chosen[group], indent="  "))
    lines.extend(_missing(schema, chosen, indent=""))
    return "".join(f"{line}\n" for line in lines)


def _missing(schema: Any, chosen: Mapping[str, Any], indent: str) -> Iterator[str]:
    """Yield a line for each setting with a default that nobody chose."""
    hints = typing.get_type_hints(schema, include_extras=True)
    for field in dataclasses.fields(schema):
        hint = hints[field.name]
        if field.name in chosen:
            continue
        if dataclasses.is_dataclass(hint):
            yield f"{indent}{field.name}:{MARK}"
            yield from _missing(hint, {}, f"{indent}  ")
            continue
        default = field.default
        if field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        if default is not dataclasses.MISSING:
            value = _as_yaml(default)
            yield f"{indent}{field.name}: {value}{MARK}{_range_of(hint)}"


def _as_yaml(value: Any) -> str:
    """Return a value as it stands in one line of YAML."""
    text = yaml.safe_dump(
        plain(value), default_flow_style=True, sort_keys=False, width=math.inf
    )
    return text.removesuffix("...\n").strip()


def _range_of(hint: Any) -> str:
    """Return ", " with the range that an annotation states, or nothing."""
    for part in typing.get_args(hint):
        if isinstance(part, Interval):
            return f", in {part.text}"
        if isinstance(part, OneOf):
            return f", one of {', '.join(part)}"
        if found := _range_of(part):
            return found
    return ""


if __name__ == "__main__":
    for path, schema in files().items():
        before = path.read_text("utf-8")
        after = with_defaults(before, schema)
        if after != before:
            write_bytes(path, after.encode())
            print_message(f"{path}: written")
