"""The texts and choices of a results page, read from `comparison` of its settings."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from sfkd_jax.evaluation.formats import dig
from sfkd_jax.paper._setups import Setup

Printed = Mapping[str, Mapping[str, float]]
"""Numbers that the paper prints: system -> column -> number."""


class Study(NamedTuple):
    """What distinguishes one results page from another: `comparison.page`.

    Attributes:
        title: heading of the page.
        intro: first sentences of the page.
        scenario: of the figure of the first episode, and of the film; empty for none.
        rivals: systems that the text compares SFKD with, the main one first.
        variations: heading of the sections on variations of the protocol.
        varied: what the filled marks of their figures show.
        unvaried: name of the protocol without a variation.
        unvaried_last: whether it comes after the variations and not before.
        variations_note: below their tables.
        printed_as: system -> system whose numbers the paper prints for it.
        printed: `comparison.paper` as a table.
    """

    title: str = "A comparison, row by row"
    intro: str = ""
    scenario: str = "s3"
    rivals: tuple[str, ...] = ()
    variations: str = "Cost of a variation"
    varied: str = "under the variation in the title of the panel"
    unvaried: str = "as it is"
    unvaried_last: bool = False
    variations_note: str = ""
    printed_as: Mapping[str, str] = MappingProxyType({})
    printed: Printed = MappingProxyType({})

    def number(self, system: str, column: str) -> Any:
        """What the paper prints, or None."""
        return dig(self.printed.get(system), column)

    def prints(self, column: str) -> bool:
        """Whether the paper prints a column for any system."""
        return any(column in numbers for numbers in self.printed.values())

    def is_printed(self, group: list[Setup]) -> bool:
        """Whether the paper prints an RMSE on any scenario of these setups."""
        names = {name for setup in group for name in setup.scenarios}
        return any(self.prints(f"rmse_{name}_m") for name in names)


def study_of(results: dict[str, Any], page: dict[str, Any] | None = None) -> Study:
    """The study of a document.

    Args:
        results: content of results.json.
        page: `comparison.page` for results whose settings do not record it.

    Raises:
        ValueError: the page has an entry that `Study` does not have.
    """
    comparison = dig(results, "config", "comparison") or {}
    texts = page or comparison.get("page") or {}
    unknown = sorted(set(texts) - set(Study._fields[:-1]))
    if unknown:
        known = ", ".join(Study._fields[:-1])
        raise ValueError(f"unknown comparison.page.{unknown[0]}; choose of {known}")
    paper = comparison.get("paper") or {}
    columns = paper.get("columns") or []
    printed = {
        name: dict(zip(columns, values, strict=False))
        for name, values in paper.items()
        if name != "columns" and isinstance(values, list)
    }
    same = texts.get("printed_as") or {}
    printed |= {name: printed[one] for name, one in same.items() if one in printed}
    return Study(**texts, printed=printed)
