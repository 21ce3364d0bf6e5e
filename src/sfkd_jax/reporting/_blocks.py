"""What a report is made of, and how each piece reads in HTML and Markdown. Text is plain and escaped here."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from matplotlib.figure import Figure

from sfkd_jax.reporting._style import CSS, save


class Heading(NamedTuple):
    """A heading of level 1 to 3."""

    level: int
    text: str


class Text(NamedTuple):
    """A paragraph; `lead` are its first words, set in bold; `kind` is "", "lead", "sub" or "note"."""

    text: str
    lead: str = ""
    kind: str = ""


class Tiles(NamedTuple):
    """Key figures: (name, value)."""

    items: list[tuple[str, str]]


class Table(NamedTuple):
    """A table of finished strings; the first column names the row.

    `strong` are the rows to stress; `prose` means left-aligned words instead of right-aligned numbers.
    """

    header: list[str]
    rows: list[list[str]]
    strong: tuple[int, ...] = ()
    prose: bool = False


class Picture(NamedTuple):
    """A PNG with its caption."""

    path: Path
    caption: str


class Code(NamedTuple):
    """A command."""

    text: str


class Missing(NamedTuple):
    """An input that is not there, and the command that makes it."""

    what: str
    command: str


def picture(
    place: Path, name: str, caption: str, draw: Callable[..., Figure], *inputs: Any
) -> Picture:
    """Draw a figure into a folder."""
    return Picture(save(place / f"{name}.png", draw, *inputs), caption)


Block: TypeAlias = Heading | Text | Tiles | Table | Picture | Code | Missing

_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


def to_html(title: str, blocks: list[Block]) -> str:
    """One self-contained page: figures and style inline, no script, and a policy that forbids requests."""
    body = "\n".join(_html(block) for block in blocks)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{CSS}</style>\n</head>\n"
        f"<body>\n<main>\n{body}\n</main>\n</body>\n</html>\n"
    )


def to_markdown(blocks: list[Block]) -> str:
    """The same report as Markdown, figures linked from `figures/`."""
    return "\n\n".join(_markdown(block) for block in blocks) + "\n"


def _html(block: Block) -> str:
    match block:
        case Heading(level, text):
            return f"<h{level}>{escape(text)}</h{level}>"
        case Text(text, lead, kind):
            start = f"<strong>{escape(lead)}</strong> " if lead else ""
            return f"<p{f' class={kind}' if kind else ''}>{start}{_bound(escape(text))}</p>"
        case Tiles(items):
            tiles = "".join(
                f"<div><dt>{escape(k)}</dt><dd>{escape(v)}</dd></div>" for k, v in items
            )
            return f'<dl class="tiles">{tiles}</dl>'
        case Table():
            return _html_table(block)
        case Picture(path, caption):
            data = base64.b64encode(path.read_bytes()).decode("ascii")
            kind = path.suffix.removeprefix(".")
            image = (
                f'<img alt="{escape(caption)}" src="data:image/{kind};base64,{data}">'
            )
            return f"<figure>{image}<figcaption>{_bound(escape(caption))}</figcaption></figure>"
        case Code(text):
            return f"<pre><code>{escape(text)}</code></pre>"
        case Missing(what, command):
            code = f"<pre><code>{escape(command)}</code></pre>"
            return f'<div class="missing"><p>{escape(_lacking(what))}</p>{code}</div>'


def _html_table(table: Table) -> str:
    head = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in table.header)
    rows = []
    for place, (first, *rest) in enumerate(table.rows):
        cells = "".join(f"<td>{escape(cell)}</td>" for cell in rest)
        strong = ' class="strong"' if place in table.strong else ""
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
            return "\n".join(
                f"- {_plain(name)}: {_plain(value)}" for name, value in items
            )
        case Table(header, rows, strong, prose):
            stress = [
                [f"**{_plain(c)}**" if i in strong else _plain(c) for c in row]
                for i, row in enumerate(rows)
            ]
            rule = [":--"] + [":--" if prose else "--:"] * (len(header) - 1)
            lines = [[_plain(cell) for cell in header], rule, *stress]
            return "\n".join(f"| {' | '.join(line)} |" for line in lines)
        case Picture(path, caption):
            return f"![{_plain(caption)}](figures/{path.name})\n\n{_plain(caption)}"
        case Code(text):
            return "    " + " ".join(text.split())
        case Missing(what, command):
            return f"{_plain(_lacking(what))}\n\n    {' '.join(command.split())}"


def _lacking(what: str) -> str:
    return f"{what} is missing from this run directory, so this part is left out. The command that makes it:"


def _bound(text: str) -> str:
    """Keep a number and its unit on one line."""
    return re.sub(r"(?<=\d) (?=(%|m|s|ms|rad|m/s|rad/s)(?![\w]))", "\u00a0", text)


def _plain(text: str) -> str:
    """One line of Markdown in which nothing of `text` is markup."""
    line = " ".join(text.split())
    for mark in "\\`*_[]|":
        line = line.replace(mark, "\\" + mark)
    return escape(line, quote=False)
