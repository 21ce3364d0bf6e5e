"""What the pages name exists (links, files, commands, options, names), what they compute
runs, and every table of numbers is made from a committed result.
"""

import ast
import re
from functools import cache
from pathlib import Path

import pytest
import yaml

from benchmarks import pages
from sfkd_jax import certificate
from sfkd_jax.driving.certificate import DrivingCertificate

ROOT = Path(__file__).parents[1]
DOCS, PACKAGE = ROOT / "docs", ROOT / "src" / "sfkd_jax"
PAGES = [
    ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "ARCHITECTURE")
] + sorted(DOCS.rglob("*.md"))
FENCED = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)
# `runs` is what commands write: a page names files that are made by following it.
PLACES = {folder.name for folder in ROOT.iterdir() if folder.is_dir()} - {"runs"}
every_page = pytest.mark.parametrize(
    "page", PAGES, ids=lambda page: str(page.relative_to(ROOT))
)


@cache
def text_of(page):
    """A page with what it takes in from other files."""

    def included(match):
        name, _, section = match[1].partition(":")
        text = (ROOT / name).read_text("utf-8")
        if section:
            text = text.split(f"[start:{section}] -->\n")[1].split(
                f"<!-- --8<-- [end:{section}]"
            )[0]
        return text

    return re.sub(
        r'^--8<-- "([^"]+)"$', included, page.read_text("utf-8"), flags=re.MULTILINE
    )


@cache
def anchors_of(page):
    """Headings as GitHub and the site name them."""
    titles = re.findall(r"^#+ (.+)$", FENCED.sub("", text_of(page)), re.MULTILINE)
    return {
        re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-")
        for title in titles
    }


def spans_of(page):
    """Words in backticks."""
    return [
        word
        for span in re.findall(r"`([^`\n]+)`", FENCED.sub("", text_of(page)))
        for word in span.split()
    ]


@every_page
def test_every_relative_link_and_image_leads_somewhere(page):
    text = re.sub(r"`[^`\n]*`", "", FENCED.sub("", page.read_text("utf-8")))
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"\w+:", target):
            continue
        name, _, anchor = target.partition("#")
        file = (page.parent / name).resolve() if name else page
        assert file.exists(), target
        assert not anchor or anchor in anchors_of(file), target


@every_page
def test_every_file_named_in_backticks_exists(page):
    words = [word.rstrip(",;:") for word in spans_of(page)]
    paths = [word for word in words if re.fullmatch(r"[\w.-]+(/[\w.-]+)*/?", word)]
    named = [
        path
        for path in paths
        if path.split("/")[0] in PLACES and "/" in path and "NAME" not in path
    ]
    named += re.findall(r"python ((?:examples|benchmarks)/[\w./-]+)", text_of(page))
    assert [
        name
        for name in named
        if not any((base / name).exists() for base in (ROOT, DOCS, PACKAGE))
    ] == []


@every_page
def test_every_command_and_every_option_exists(page):
    text = text_of(page)
    for name in re.findall(r"python -m sfkd_jax\.(\w+)", text):
        if name != "COMMAND":
            files = PACKAGE / f"{name}.py", PACKAGE / name / "__main__.py"
            assert any(file.exists() for file in files), name
    lines = re.findall(r"^python -m .*$", text, re.MULTILINE)
    words = [word for line in lines for word in line.split()] + spans_of(page)
    groups = "|".join(
        folder.name for folder in (ROOT / "conf").iterdir() if folder.is_dir()
    )
    for word in words:
        if option := re.fullmatch(
            rf"\+?({groups})=([a-z0-9_]+(?:,[a-z0-9_]+)*)[,;:]?", word
        ):
            for name in option[2].split(","):
                assert (ROOT / "conf" / option[1] / f"{name}.yaml").exists(), word


@every_page
def test_every_program_imports_what_the_package_has(page):
    for block in re.findall(
        r"^```py(?:thon)?\n(.*?)^```", text_of(page), re.DOTALL | re.MULTILINE
    ):
        imports = [
            ast.unparse(node)
            for node in ast.walk(ast.parse(block))
            if isinstance(node, ast.Import | ast.ImportFrom)
            and "run_controller" not in ast.unparse(node)
        ]
        exec("\n".join(imports), {})


@pytest.mark.parametrize("name", ["model", "corridor", "certificate", "planner"])
def test_the_programs_of_a_page_run(name, monkeypatch):
    monkeypatch.chdir(ROOT)
    blocks = re.findall(
        r"^```python\n(.*?)^```",
        (DOCS / f"{name}.md").read_text("utf-8"),
        re.DOTALL | re.MULTILINE,
    )
    assert blocks
    exec("\n".join(blocks), {})


def test_every_page_is_in_the_navigation_and_nothing_else_is():
    def entries(entry):
        if isinstance(entry, str):
            return [entry]
        parts = entry.values() if isinstance(entry, dict) else entry
        return [page for part in parts for page in entries(part)]

    settings = yaml.load((ROOT / "mkdocs.yml").read_text("utf-8"), yaml.BaseLoader)
    assert sorted(entries(settings["nav"])) == sorted(
        str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md")
    )


def test_every_table_of_numbers_is_made_from_a_committed_result():
    claims = certificate.read(
        pages.PRETRAINED / "kinematic_path/certificate.json",
        DrivingCertificate,
    )
    enemy = claims.corridor.attack.shielded_lateral_m
    limit = f"got the kinematic car {enemy:.1f} m aside"
    found = pages.read("experiments/simulator.json")
    errors = "{estimated_rmse_mm} mm in place of {rmse_mm}".format(**found)
    # A phrase may go on in the next line.
    prose = {
        name: " ".join((DOCS / f"{name}.md").read_text("utf-8").split())
        for name in ("your-vehicle", "failures")
    }
    assert errors in prose["your-vehicle"]
    small = pages.read("experiments/slipx.json")
    for words in (
        "the corridor was {corridor_m} m, and the error {rmse_mm} mm",
        "The law alone had {law_rmse_mm} mm",
        "Pure pursuit had {pure_pursuit_rmse_mm} mm and Stanley's law "
        "{stanley_rmse_mm} mm",
        "drove on time; it had {nominal_mppi_rmse_mm} mm",
        "at most {worst_m} m from its path",
    ):
        assert words.format(**small) in prose["your-vehicle"]
    assert limit in prose["failures"]
    for page, text in pages.written().items():
        assert page.read_text("utf-8") == text, (
            f"{page.name}: run python -m benchmarks.pages"
        )


def test_the_first_screen_holds_the_two_commands_and_ci_runs_one_of_them():
    screen = "\n".join((ROOT / "README.md").read_text("utf-8").splitlines()[:25])
    assert "python -m sfkd_jax.train +experiment=s3" in screen
    assert "&& pytest -q -n 2" in screen
    assert "pytest -q -n 2" in (ROOT / ".ci" / "run").read_text("utf-8")
