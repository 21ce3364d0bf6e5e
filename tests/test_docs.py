"""What the pages name exists: links, anchors, files, commands, options, functions,
numbers; and all are on the site.
"""

import ast
import re
from functools import cache
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
DOCS, PACKAGE = ROOT / "docs", ROOT / "src" / "sfkd_jax"
PAGES = [
    ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "ARCHITECTURE")
] + sorted(DOCS.rglob("*.md"))
FENCED = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)
PACKAGES = {
    folder.name for folder in PACKAGE.iterdir() if (folder / "__init__.py").exists()
}
PLACES = {
    "examples",
    "conf",
    "benchmarks",
    "docs",
    "experiments",
    "tests",
    "src",
    ".ci",
    *PACKAGES,
}
COMMANDS = {
    file.stem for file in PACKAGE.glob("*.py") if "__main__" in file.read_text("utf-8")
}
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


@cache
def names_in(*parts):
    """What a module of the package offers, read from its source."""
    directory = PACKAGE.joinpath(*parts)
    source = (
        directory / "__init__.py"
        if directory.is_dir()
        else directory.with_suffix(".py")
    )
    result = (
        {file.stem for file in directory.iterdir()} if directory.is_dir() else set()
    )
    for node in ast.walk(ast.parse(source.read_text("utf-8"))):
        if isinstance(node, ast.ImportFrom):
            result |= {alias.asname or alias.name for alias in node.names}
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            result.add(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            result |= {target.id for target in targets if isinstance(target, ast.Name)}
    return result


@every_page
def test_every_relative_link_and_image_leads_somewhere(page):
    targets = re.findall(
        r"\]\(([^)\s]+)\)", re.sub(r"`[^`\n]*`", "", FENCED.sub("", text_of(page)))
    )
    for target in targets:
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
        if ("/" in path and path.split("/")[0] in PLACES) or path.endswith(".md")
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
    assert set(re.findall(r"python -m sfkd_jax\.(\w+)", text)) <= COMMANDS
    commands = [
        word
        for line in re.findall(r"^python -m .*$", text, re.MULTILINE)
        for word in line.split()
    ]
    groups = "|".join(
        folder.name for folder in (ROOT / "conf").iterdir() if folder.is_dir()
    )
    for word in commands + spans_of(page):
        if option := re.fullmatch(
            rf"\+?({groups})=([a-z0-9_]+(?:,[a-z0-9_]+)*)[,;:]?", word
        ):
            for name in option[2].split(","):
                assert (ROOT / "conf" / option[1] / f"{name}.yaml").exists(), word


@every_page
def test_every_program_names_what_the_package_has(page):
    for block in re.findall(
        r"^```py(?:thon)?\n(.*?)^```", text_of(page), re.DOTALL | re.MULTILINE
    ):
        tree = ast.parse(block)
        modules = {"sfkd_jax": ()}
        for node in ast.walk(tree):
            package, *directory = (getattr(node, "module", None) or "").split(".")
            if isinstance(node, ast.ImportFrom) and package == "sfkd_jax":
                assert {alias.name for alias in node.names} <= names_in(*directory), (
                    node.module
                )
                modules |= {
                    alias.asname or alias.name: (alias.name,)
                    for alias in node.names
                    if alias.name in PACKAGES
                }
        for node in ast.walk(tree):
            if (
                isinstance(node, ast.Attribute)
                and isinstance(node.value, ast.Name)
                and node.value.id in modules
            ):
                known = names_in(*modules[node.value.id]) | {"__file__"}
                assert node.attr in known, ast.unparse(node)


def test_every_page_is_in_the_navigation_and_nothing_else_is():
    def pages(entry):
        if isinstance(entry, str):
            return [entry]
        return [
            page
            for part in (entry.values() if isinstance(entry, dict) else entry)
            for page in pages(part)
        ]

    nav = pages(
        yaml.load((ROOT / "mkdocs.yml").read_text("utf-8"), yaml.BaseLoader)["nav"]
    )
    assert sorted(nav) == sorted(
        str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md")
    )


def test_every_public_package_has_a_page_of_the_reference():
    pages = "".join(page.read_text("utf-8") for page in (DOCS / "api").glob("*.md"))
    private = {"store", "build", "cli", "core", "paper", "pipeline", "reporting"}
    assert {
        package
        for package in PACKAGES - private
        if f"::: sfkd_jax.{package}\n" not in pages
    } == set()
