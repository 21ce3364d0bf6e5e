"""What the site does to docstrings before they are parsed: one argument a line, and links where a public name stands.

The project writes several short arguments on one line, `horizon: T. num_samples: M.`; the Google format wants a line
for each.
"""

from __future__ import annotations

import re
from typing import Any

import griffe

HEADS = {"Args:", "Attributes:", "Raises:"}
ITEM = re.compile(r"(?:^|(?<=[.;,\])] ))((?:\w+, )*\w+): (?=\S)")
NAME = re.compile(r"(?<![`\w])`([A-Za-z_]\w*)`(?!`)")
STAR = re.compile(r"(?<=\w)\*(?=\()")
ZERO_WIDTH_SPACE = "\u200b"


def one_a_line(text: str, known: set[str]) -> str:
    """Give every argument, attribute or error in the sections of a docstring a line of its own.

    Args:
        text: a docstring. known: names that may start an item.
    """
    lines: list[str] = []
    inside = False
    for line in text.splitlines():
        if line and not line.startswith(" "):
            inside = line.strip() in HEADS
        elif inside and line.strip():
            lines += _split(line, known)
            continue
        lines.append(line)
    return "\n".join(lines)


def _split(line: str, known: set[str]) -> list[str]:
    """The items of one line, each on its own; what comes before the first of them continues the item above."""
    body, indent = line.strip(), line[: len(line) - len(line.lstrip())]
    starts = [
        match for match in ITEM.finditer(body) if set(match[1].split(", ")) <= known
    ]
    before = body[: starts[0].start()] if starts else body
    parts = [indent + before.strip()] if before.strip() else []
    for place, match in enumerate(starts):
        end = starts[place + 1].start() if place + 1 < len(starts) else len(body)
        said = body[match.end() : end].strip().rstrip(",")
        parts += [f"    {name}: {said}" for name in match[1].split(", ")]
    return parts


def linked(text: str, places: dict[str, str]) -> str:
    """Turn `name` into a link where a name is public, and keep Markdown away from units in brackets and from u*(κ)."""
    text = STAR.sub(r"\\*", text.replace("] [", f"]{ZERO_WIDTH_SPACE} ["))
    return NAME.sub(
        lambda match: (
            f"[{match[0]}][{places[match[1]]}]" if match[1] in places else match[0]
        ),
        text,
    )


def _has_an_entry(seen: Any) -> bool:
    """Whether the reference shows a member of a room."""
    if seen.name.startswith("_") or (seen.is_alias and not seen.public):
        return False
    try:
        return seen.docstring is not None
    except griffe.AliasResolutionError:  # of another package
        return False


class Docstrings(griffe.Extension):
    """Rewrites every docstring of the package once it is loaded."""

    def on_package(self, *, pkg: griffe.Module, **kwargs: Any) -> None:
        """Walk the package."""
        del kwargs
        for room in pkg.members.values():
            if room.is_alias or not room.is_module:
                continue
            places = {
                name: f"{room.path}.{name}"
                for name, seen in room.members.items()
                if _has_an_entry(seen)
            }
            self._walk(room, places)

    def _walk(self, place: Any, places: dict[str, str]) -> None:
        """Rewrite a module or class and what is in it."""
        for seen in place.members.values():
            if not seen.is_alias:
                self._rewrite(seen, places)
                self._walk(seen, places)

    def _rewrite(self, seen: Any, places: dict[str, str]) -> None:
        """Rewrite one docstring."""
        if seen.docstring is None:
            return
        known = set(seen.members)
        known |= (
            {parameter.name for parameter in seen.parameters}
            if seen.is_function
            else set()
        )
        known |= set(re.findall(r"\b[A-Z]\w+(?=: )", seen.docstring.value))  # errors
        seen.docstring.value = linked(one_a_line(seen.docstring.value, known), places)
