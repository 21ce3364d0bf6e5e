"""Parts of a page, and how each is written in HTML and in Markdown."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable
from html import escape
from pathlib import Path
from string import Template
from typing import Any, NamedTuple, TypeAlias

from matplotlib.figure import Figure

from sfkd_jax.reporting.style import save


class Heading(NamedTuple):
    """A heading of level 1 to 3."""

    level: int
    text: str


class Text(NamedTuple):
    """A paragraph of plain text, escaped when it is written.

    Attributes:
        text: of the paragraph.
        lead: its first words, set in bold.
        kind: "", "lead", "sub", "note" or "missing".
    """

    text: str
    lead: str = ""
    kind: str = ""


class Tiles(NamedTuple):
    """Key figures, as pairs of name and value."""

    items: list[tuple[str, str]]


class Table(NamedTuple):
    """A table of strings; the first column names the row.

    Attributes:
        header: of all columns.
        rows: of all columns.
        strong: indices of the rows to stress.
        prose: whether columns hold left-aligned text instead of right-aligned numbers.
    """

    header: list[str]
    rows: list[list[str]]
    strong: tuple[int, ...] = ()
    prose: bool = False


class Picture(NamedTuple):
    """An image file with its caption."""

    path: Path
    caption: str


class Code(NamedTuple):
    """A command."""

    text: str


Block: TypeAlias = Heading | Text | Tiles | Table | Picture | Code

_PAGE = Template(Path(__file__).with_name("page.html").read_text("utf-8"))


def picture(
    folder: Path, name: str, caption: str, draw: Callable[..., Figure], *inputs: Any
) -> Picture:
    """Draw a figure into a folder."""
    return Picture(save(folder / f"{name}.png", draw, *inputs), caption)


def missing(name: str, command: str) -> list[Block]:
    """Say that a file is missing, and which command makes it."""
    text = f"{name} is missing from this run directory, so this part is left out."
    return [Text(f"{text} The command that makes it:", kind="missing"), Code(command)]


def to_html(title: str, blocks: list[Block]) -> str:
    """A self-contained page: inline figures and style, no script, no requests."""
    body = "\n".join(_html(block) for block in blocks)
    return _PAGE.substitute(title=escape(title), body=body)


def to_markdown(blocks: list[Block]) -> str:
    """The same page as Markdown, with figures linked from `figures/`."""
    return "\n\n".join(_markdown(block) for block in blocks) + "\n"


def _html(block: Block) -> str:
    match block:
        case Heading(level, text):
            return f"<h{level}>{escape(text)}</h{level}>"
        case Text(text, lead, kind):
            start = f"<strong>{escape(lead)}</strong> " if lead else ""
            tag = f"<p class={kind}>" if kind else "<p>"
            return f"{tag}{start}{_with_units(text)}</p>"
        case Tiles(items):
            pairs = [
                f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>"
                for name, value in items
            ]
            return f'<dl class="tiles">{"".join(pairs)}</dl>'
        case Table():
            return _html_table(block)
        case Picture(path, caption):
            data = base64.b64encode(path.read_bytes()).decode("ascii")
            source = f"data:image/{path.suffix.removeprefix('.')};base64,{data}"
            image = f'<img alt="{escape(caption)}" src="{source}">'
            below = f"<figcaption>{_with_units(caption)}</figcaption>"
            return f"<figure>{image}{below}</figure>"
        case Code(text):
            return f"<pre><code>{escape(text)}</code></pre>"


def _html_table(table: Table) -> str:
    head = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in table.header)
    rows = []
    for index, (first, *rest) in enumerate(table.rows):
        cells = "".join(f"<td>{escape(cell)}</td>" for cell in rest)
        strong = ' class="strong"' if index in table.strong else ""
        rows.append(f'<tr{strong}><th scope="row">{escape(first)}</th>{cells}</tr>')
    kind = "prose" if table.prose else "data"
    return (
        f'<div class="scroll"><table class="{kind}"><thead><tr>{head}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _markdown(block: Block) -> str:
    match block:
        case Heading(level, text):
            return f"{'#' * level} {_plain(text)}"
        case Text(text, lead, _):
            return f"**{_plain(lead)}** {_plain(text)}" if lead else _plain(text)
        case Tiles(items):
            return "\n".join(f"- {_plain(f'{key}: {value}')}" for key, value in items)
        case Table(header, rows, strong, prose):
            stressed = [
                [f"**{_plain(c)}**" if i in strong else _plain(c) for c in row]
                for i, row in enumerate(rows)
            ]
            rule = [":--"] + [":--" if prose else "--:"] * (len(header) - 1)
            lines = [[_plain(cell) for cell in header], rule, *stressed]
            return "\n".join(f"| {' | '.join(line)} |" for line in lines)
        case Picture(path, caption):
            return f"![{_plain(caption)}](figures/{path.name})\n\n{_plain(caption)}"
        case Code(text):
            return "    " + " ".join(text.split())


def _with_units(text: str) -> str:
    """Escape text, and keep a number and its unit on one line."""
    unit = r"(?<=\d) (?=(%|m|s|ms|rad|m/s|rad/s)(?![\w]))"
    return re.sub(unit, "\u00a0", escape(text))


def _plain(text: str) -> str:
    """One line of Markdown without any mark-up from `text`."""
    line = " ".join(text.split())
    for mark in "\\`*_[]|":
        line = line.replace(mark, "\\" + mark)
    return escape(line, quote=False)
