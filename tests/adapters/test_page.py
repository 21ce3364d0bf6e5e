"""The snippets of docs/adapters.md run as they stand."""

import re
from pathlib import Path

import pytest

PAGE = (Path(__file__).parents[2] / "docs" / "adapters.md").read_text("utf-8")
SNIPPETS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


@pytest.mark.parametrize(
    ("number", "shown"), [(0, "(4, 47)"), (1, "(47,)"), (2, "(8, 21, 7)")]
)
def test_a_snippet_runs_and_prints_what_the_page_says(number, shown, capsys):
    assert len(SNIPPETS) == 3
    exec(compile(SNIPPETS[number], f"docs/adapters.md, snippet {number}", "exec"), {})
    assert shown in capsys.readouterr().out
