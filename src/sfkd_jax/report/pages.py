"""A page as a record, and the same page as HTML, Markdown and LaTeX."""

from __future__ import annotations

import base64
import re
from pathlib import Path
from typing import NamedTuple, TypeAlias

from jinja2 import Environment, PackageLoader, StrictUndefined

from sfkd_jax.report.rows import Table
from sfkd_jax.store import write_bytes


class Text(NamedTuple):
    """A short paragraph, or with `code` a text to copy."""

    text: str
    code: bool = False


class Picture(NamedTuple):
    """An image file, and a few words for a reader who cannot see it."""

    path: Path
    alt: str


Part: TypeAlias = Text | Picture | Table


class Section(NamedTuple):
    """A heading with what is below it; `folded` hides that until a reader asks."""

    title: str
    parts: list[Part]
    folded: bool = False


class Page(NamedTuple):
    """A page of sections; those without parts are left out."""

    title: str
    sections: list[Section]


def write_page(page: Page, html: Path, markdown: Path) -> dict[str, object]:
    """Write a page, and return where it and its images are.

    The HTML has its figures inside, and links films, which are larger; the Markdown
    links both. Links are relative to the page.
    """
    for path in (html, markdown):
        template = _ENVIRONMENT.get_template(f"page{path.suffix}")
        write_bytes(path, template.render(page=page, home=path.parent).encode())
    parts = [part for section in page.sections for part in section.parts]
    pictures = [str(part.path) for part in parts if isinstance(part, Picture)]
    return {"report": str(html), "figures": pictures}


def to_latex(captions: list[tuple[str, Table]]) -> str:
    """Tables with their captions as floats for booktabs."""
    return _ENVIRONMENT.get_template("tables.tex").render(tables=captions)


def _source(path: Path, home: Path) -> str:
    """What an image links: its content, or for a film its place."""
    if path.suffix == ".gif":
        return path.relative_to(home).as_posix()
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    return f"data:image/{path.suffix.removeprefix('.')};base64,{data}"


def _plain(text: str) -> str:
    """One line of Markdown without any mark-up from `text`."""
    line = re.sub(r"([\\`*_\[\]|])", r"\\\1", " ".join(text.split()))
    return line.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


_TEX = {
    **{letter: f"\\{letter}" for letter in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "−": "$-$",
    "±": r"$\pm$",
    "–": "--",
    "α": r"$\alpha$",
    "†": r"\textdagger{}",
    "<": "$<$",
    ">": "$>$",
}


def _tex(text: str) -> str:
    return "".join(_TEX.get(letter, letter) for letter in text)


_ENVIRONMENT = Environment(
    loader=PackageLoader("sfkd_jax.report"),
    autoescape=lambda name: (name or "").endswith(".html"),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_ENVIRONMENT.filters |= {"source": _source, "plain": _plain, "tex": _tex}
