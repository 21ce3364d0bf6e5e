"""The quickstart notebook runs, and its page shows its cells."""

import json
import re
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
NOTEBOOK = json.loads((ROOT / "examples" / "quickstart.ipynb").read_text("utf-8"))
CELLS = [
    "".join(cell["source"]) for cell in NOTEBOOK["cells"] if cell["cell_type"] == "code"
]


def test_the_page_shows_the_cells_of_the_notebook():
    page = (ROOT / "docs" / "notebook.md").read_text("utf-8")
    blocks = re.findall(r"^```python\n(.*?)\n```$", page, re.DOTALL | re.MULTILINE)
    assert blocks == CELLS


@pytest.mark.exhaustive
def test_the_notebook_drives_inside_the_corridor_and_certifies_a_model(capsys):
    names = {}
    with mpl.rc_context({"backend": "Agg"}):
        for cell in CELLS:
            exec(compile(cell, "quickstart.ipynb", "exec"), names)
    half = names["corridor"]["corridor_m"]
    assert np.all(np.abs(names["lateral"]) < half)
    assert np.all(np.abs(names["lateral"] - names["copy"]) < names["tube"])
    assert 0.0 < names["proof"].alpha < 1.0
    assert "does not follow from its witness" in capsys.readouterr().out
