"""Tables in Markdown, with a mark at every number that what ships did not make."""

from typing import NamedTuple

from benchmarks import is_old

OLD = "‡"
OLD_MEANS = (
    f"{OLD} Driven with earlier code or other weights than what ships, or it was not noted "
    "with which. In a heading the mark is for the whole row or column."
)
HEADING = -1
"""Number of the row of headings; the rows below it are counted from 0."""


class Measured(NamedTuple):
    """A number as a table shows it, and whether other code or weights made it."""

    text: str
    old: bool

    def __str__(self):
        return self.text


def measured(text, *rows, policy=None):
    """A number of committed rows, which `policy` drove if it is one that ships."""
    return Measured(text, any(is_old(row, policy) for row in rows))


def table(heads, rows):
    """A table, and below it what the mark means if there is one.

    A mark stands once in the first heading if it is for all numbers of the table, else
    once in the heading of a column or row if it is for all numbers of that.

    Args:
        heads: of the columns.
        rows: of entries, the first of which names the row. Those that are `Measured` can
            be old.
    """
    ages = {
        (number, column): entry.old
        for number, row in enumerate(rows)
        for column, entry in enumerate(row)
        if isinstance(entry, Measured)
    }
    old = {place for place, aged in ages.items() if aged}
    new = ages.keys() - old
    columns = {column for _, column in old} - {column for _, column in new}
    beside = {(row, column) for row, column in old if column not in columns}
    whole_rows = {row for row, _ in beside} - {row for row, _ in new}
    if len(columns) == len(heads) - 1:
        marked = {(HEADING, 0)}
    else:
        marked = {(HEADING, column) for column in columns}
        marked |= {(row, 0) for row in whole_rows}
        marked |= {place for place in beside if place[0] not in whole_rows}
    texts = [
        [
            f"{entry} {OLD}" if (number, column) in marked else str(entry)
            for column, entry in enumerate(row)
        ]
        for number, row in enumerate([heads, *rows], start=HEADING)
    ]
    made = markdown(texts[0], texts[1:])
    return f"{made}\n\n{OLD_MEANS}" if old else made


def markdown(heads, rows):
    """A table in Markdown; a bar in a cell does not end it."""
    lines = [heads, ["---"] * len(heads), *rows]
    escaped = ([str(cell).replace("|", "\\|") for cell in line] for line in lines)
    return "\n".join(f"| {' | '.join(cells)} |" for cells in escaped)
