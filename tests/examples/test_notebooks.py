"""Notebooks: their programs parse, hold no results of somebody else, and run."""

import ast
import json
from pathlib import Path

import matplotlib
import numpy as np
import pytest

NOTEBOOKS = sorted(
    (Path(__file__).parents[2] / "examples" / "notebooks").glob("*.ipynb")
)
every_notebook = pytest.mark.parametrize(
    "notebook", NOTEBOOKS, ids=lambda path: path.stem
)


def cells_of(notebook):
    """The programs of a notebook, a text each."""
    document = json.loads(notebook.read_text("utf-8"))
    assert (document["nbformat"], document["nbformat_minor"]) == (4, 5)
    return [cell for cell in document["cells"] if cell["cell_type"] == "code"]


def test_there_is_one_for_a_car_and_one_for_a_system():
    assert [path.stem for path in NOTEBOOKS] == ["car_in_its_corridor", "your_system"]


@every_notebook
def test_a_notebook_parses_and_holds_no_results(notebook):
    cells = cells_of(notebook)
    assert len(cells) >= 3
    for cell in cells:
        ast.parse("".join(cell["source"]))
        assert cell["outputs"] == []
        assert cell["execution_count"] is None


@pytest.mark.exhaustive
@every_notebook
def test_a_notebook_runs_and_what_is_claimed_holds(notebook, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    names = {}
    for cell in cells_of(notebook):
        exec("".join(cell["source"]), names)
    # Of the two notebooks each has one of these.
    errors = np.abs(names["lateral"] if "lateral" in names else names["errors"])
    bounds = np.asarray(names["claim"] if "claim" in names else names["bounds"])
    assert np.all(errors[np.isfinite(bounds)] <= bounds[np.isfinite(bounds)])
    assert np.isfinite(bounds).mean() > 0.9
