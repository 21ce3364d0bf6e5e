"""Tables in Markdown, and their places in pages that are written by hand around them."""

import re


def table(heads, rows):
    """A table; a bar in a cell does not end it."""
    lines = [heads, ["---"] * len(heads), *rows]
    escaped = ([str(cell).replace("|", "\\|") for cell in line] for line in lines)
    return "\n".join(f"| {' | '.join(cells)} |" for cells in escaped)


def filled(page, made):
    """A page with tables between <!-- NAME --> and the next <!-- end -->.

    Raises:
        SystemExit: a table has no place in the page, or several.
    """
    for name, text in made.items():
        pattern = re.compile(rf"<!-- {name} -->\n.*?<!-- end -->", re.DOTALL)
        place = f"<!-- {name} -->\n{text}\n<!-- end -->"
        page, count = pattern.subn(lambda _, place=place: place, page)
        if count != 1:
            raise SystemExit(f"{count} places for the table {name!r}, not 1")
    return page


def put(path, made):
    """Write tables into their places in the page of a file; see `filled`."""
    path.write_text(filled(path.read_text("utf-8"), made), "utf-8")
