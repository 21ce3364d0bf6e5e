"""A page of texts, images and tables as HTML, and tables as LaTeX."""

from __future__ import annotations

import base64
import html
import re
from pathlib import Path
from typing import NamedTuple, TypeAlias

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined

from sfkd_jax.store import write_bytes


class Picture(NamedTuple):
    """An image file, and a few words for a reader who cannot see it."""

    path: Path
    alt: str


Part: TypeAlias = str | Picture | pd.DataFrame


class Section(NamedTuple):
    """A heading with what is below it; `folded` hides that until a reader asks."""

    title: str
    parts: list[Part]
    folded: bool = False


def write_page(title: str, sections: list[Section], home: Path) -> dict[str, object]:
    """Write home/index.html; return where it and its images are.

    The page contains its figures, and links films, which are larger. Sections without
    parts are left out.
    """
    sections = [section for section in sections if section.parts]
    filled = _ENVIRONMENT.get_template("page.html").render(
        title=title,
        sections=[
            section._replace(parts=[_as_html(part, home) for part in section.parts])
            for section in sections
        ],
    )
    write_bytes(home / "index.html", filled.encode())
    parts = [part for section in sections for part in section.parts]
    pictures = [str(part.path) for part in parts if isinstance(part, Picture)]
    return {"report": str(home / "index.html"), "figures": pictures}


def to_latex(captions: list[tuple[str, pd.DataFrame]]) -> str:
    """Return tables with their captions as floats for booktabs."""
    text = "% Needs \\usepackage{booktabs}.\n"
    for caption, frame in captions:
        words = re.sub(r"([&%$#_{}])", r"\\\1", caption.replace("\\", "/"))
        text += frame.to_latex(
            escape=True,
            caption=words,
            position="p",
            column_format="l" + "r" * frame.shape[1],
            multicolumn_format="c",
        )
    return text


def _as_html(part: Part, home: Path) -> str:
    """Return a part of a page as HTML; what a table or a text holds is escaped."""
    if isinstance(part, str):
        return f"<p>{html.escape(part)}</p>"
    if isinstance(part, Picture):
        source = part.path.relative_to(home).as_posix()
        if part.path.suffix == ".png":
            data = base64.b64encode(part.path.read_bytes()).decode("ascii")
            source = f"data:image/png;base64,{data}"
        return f'<img alt="{html.escape(part.alt)}" src="{source}">'
    # Numbers stand below each other by their last digit, words begin on the left.
    share_of_numbers = part.map(_begins_with_a_number).mean().mean()
    css_class = "numbers" if share_of_numbers > 0.5 else "words"
    with pd.option_context("display.max_colwidth", None):
        rows = part.to_html(classes=css_class, border=0, escape=True, justify="right")
    # The row of this project's model is marked.
    rows = re.sub(r"<tr>(\s*<th>SFKD</th>)", r'<tr class="strong">\1', rows)
    return f'<div class="scroll">{rows}</div>'


def _begins_with_a_number(cell: str) -> bool:
    """Return whether a cell shows a number, perhaps with a sign or as a bound."""
    return cell[:1] in "0123456789−–<"


_ENVIRONMENT = Environment(
    loader=PackageLoader("sfkd_jax.report"), autoescape=True, undefined=StrictUndefined
)
