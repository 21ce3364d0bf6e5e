"""Texts of a page, from a TOML file, filled in from JSON records."""

from __future__ import annotations

import string
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sfkd_jax.evaluation import formats


class _Template(string.Formatter):
    """Fills `{a.b.0:short6}` with entry 0 of entry b of record a.

    The format is a function of `formats`, with its number of digits.
    """

    def get_field(self, field_name: str, args: Any, kwargs: Any) -> tuple[Any, str]:
        return formats.dig(kwargs, *field_name.split(".")), field_name

    def format_field(self, value: Any, format_spec: str) -> str:
        name = format_spec.rstrip(string.digits)
        digits = map(int, filter(None, [format_spec[len(name) :]]))
        return getattr(formats, name)(value, *digits) if name else str(value)


def fill(template: str, record: dict[str, Any] | None = None, /, **values: Any) -> str:
    """Fill in a template from a record and further values."""
    line = " ".join(template.strip("\n").splitlines())
    return _Template().vformat(line, (), (record or {}) | values)


def load_texts(path: Path) -> Callable[..., str]:
    """The function that fills in the text `section.key` of a file, like `fill`."""
    texts = tomllib.loads(path.read_text("utf-8"))

    def text(name: str, record: dict[str, Any] | None = None, /, **values: Any) -> str:
        return fill(formats.dig(texts, *name.split(".")), record, **values)

    return text


_FILE = Path(__file__).with_name("page.toml")
_CONTENT: dict[str, Any] = tomllib.loads(_FILE.read_text("utf-8"))
AXES: dict[str, dict[str, list[list[str]]]] = _CONTENT["axes"]
"""Name and unit of the axes of every box, by frame."""
text = load_texts(_FILE)


def list_rows(section: str, record: dict[str, Any], **values: Any) -> list[list[str]]:
    """The rows of a table: the names in a section, and their templates filled in."""
    cells = ((name, line.split(" | ")) for name, line in _CONTENT[section].items())
    return [[name, *(fill(c, record, **values) for c in line)] for name, line in cells]
