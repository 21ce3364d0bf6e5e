"""What the pages name exists: links, anchors, files, commands, options, functions,
numbers; and all are on the site.
"""

import ast
import json
import re
from collections import Counter
from functools import cache
from pathlib import Path

import pytest
import yaml

from benchmarks.quality import (
    adaptation_page,
    corridor_page,
    paper_terms_page,
    path_frame,
    planner_page,
    protocol2_power,
    shield_table,
    speed_page,
)
from benchmarks.robustness import drills as drills_benchmark
from benchmarks.robustness import soak
from benchmarks.timing import performance_page

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


def test_every_result_on_the_tuning_page_is_in_the_file_it_cites():
    """All numbers with a decimal, but for names in backticks: results, or settings that
    are in use.
    """
    text = re.sub(
        r"`[^`\n]*`", "", FENCED.sub("", (DOCS / "tuning.md").read_text("utf-8"))
    )
    laws = json.loads((ROOT / "benchmarks/quality/laws.json").read_text())["rows"]
    table = json.loads(
        (ROOT / "experiments" / "table1_closed_loop" / "results.json").read_text()
    )["rows"]
    known = {f"{sum(row['rmse_mm']) / len(row['rmse_mm']):.1f}" for row in laws}
    known |= {f"{1e3 * row['rmse_m']['mean']:.1f}" for row in table}
    known |= {f"{row['max_deviation_m']:.2f}" for row in table}
    known |= {f"{rate:.3f}" for rate in [row["steering_rate"] for row in laws]}
    known |= {f"{row['smoothness_rad_per_s']:.3f}" for row in table}
    settings = {
        "0.02",
        "0.3",
        "0.06",
        "0.6",
        "0.8",
        "0.5",
    }  # noise of both kinds, its correlation, a cost, a delay [s]
    assert set(re.findall(r"\d+\.\d+", text)) - known - settings == set()


def test_the_tables_of_the_certificates_page_are_those_of_their_files():
    """Every line below a comment that names the file; and the size of the core, and
    what was searched.
    """
    page, readme = (
        file.read_text("utf-8")
        for file in (DOCS / "certificate.md", ROOT / "README.md")
    )
    result = json.loads((ROOT / "benchmarks/quality/theorem_power.json").read_text())[
        "rows"
    ]
    rows = [
        row
        for row in result
        if (row["vehicle"], row["scenario"]) == ("kinematic", "s1, s2")
    ]
    shown = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for table in re.findall(
            r"<!-- from benchmarks/quality/theorem_power.json -->\n\|.*\n\|[-|]*\n((?:\|.*\n)*)",
            page,
        )
        for line in table.splitlines()
    ]
    reach = ("reach", "reach_1", "reach_5", "reach_20")
    expected = {
        row["claim"]: [
            str(row["broken"]),
            str(row["applied"]),
            *(f"{row[name]:.2f}" for name in reach),
        ]
        for row in rows
        if row.get("reach") is not None
    }
    expected |= {
        str(row["force_n"]): [
            f"{100 * row['left'][kind]:.1f} %"
            for kind in ("latent", "position", "yaw", "body")
        ]
        for row in rows
        if "force_n" in row
    }
    assert len(shown) == 12
    assert [cells for cells in shown if expected[cells[0]] != cells[1:]] == []
    lines = len(
        (ROOT / "src/sfkd_jax/certification/_core.py").read_text("utf-8").splitlines()
    )
    assert lines <= 190
    assert f"`certification/_core.py`, {lines} lines" in page
    assert f"a core of {lines} lines" in " ".join(readme.split())
    searched = json.loads(
        (ROOT / "benchmarks/robustness/trusted_core.json").read_text()
    )
    assert searched["false_and_accepted"] == 0
    assert f"{searched['cases']:_}".replace("_", " ") + " hostile" in page
    assert (
        f"{100 * searched['accepted'] / searched['true']:.0f} % of those that hold"
        in " ".join(page.split())
    )


def rows_between(page, mark):
    """Cells of the lines below the head of a table between two marks."""
    table = page.split(f"<!-- {mark} -->\n")[1].split(f"<!-- end of {mark} -->")[0]
    return [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in table.splitlines()[2:]
    ]


def test_what_the_tests_of_a_certificate_notice_is_what_was_counted():
    """Changes by file, and by reason those that none notices, each of which is argued."""
    files = json.loads((ROOT / "benchmarks/robustness/mutants.json").read_text())[
        "files"
    ]
    page = (DOCS / "certificate.md").read_text("utf-8")
    total, killed = (
        sum(row[key] for row in files.values()) for key in ("total", "killed")
    )
    counted = [
        [f"`{name}`", str(row["total"]), str(row["killed"])]
        for name, row in files.items()
    ]
    assert rows_between(page, "mutants") == [
        *counted,
        ["all", str(total), f"{killed} ({100 * killed / total:.1f} %)"],
    ]
    reasons = Counter(
        reason for row in files.values() for reason in row["survived"].values()
    )
    assert {
        reason: int(count) for reason, count in rows_between(page, "survivors")
    } == reasons
    assert "not argued" not in reasons
    assert killed + reasons.total() == total
    assert killed >= 0.95 * total
    assert (
        f"by hand {sum(row['named'] for row in files.values())} mistakes"
        in " ".join(page.split())
    )
    assert not [
        what
        for row in files.values()
        for what in row["survived"]
        if what.startswith("named")
    ]


def test_the_page_about_an_estimated_environment_says_what_the_results_say():
    """Every number of its table, and the differences that the text draws from it."""
    result, table = (
        json.loads((ROOT / "experiments" / name / "results.json").read_text())["rows"]
        for name in ("estimated", "table1_closed_loop")
    )
    drives = [
        (vehicle, scenario)
        for vehicle in ("kinematic", "dynamic")
        for scenario in ("s2", "s3")
    ]

    def driven(variation):
        return [
            next(
                1e3 * row["rmse_m"]["mean"]
                for row in result
                if (row["vehicle"], row["scenario"], row["variation"], row["system"])
                == (*drive, variation, "sfkd")
            )
            for drive in drives
        ]

    untold = [
        min(
            1e3 * row["rmse_m"]["mean"]
            for row in table
            if (row["vehicle"], row["scenario"], row["env"]) == (*drive, "none")
            and row["system"] != "nominal"
            and row["sampling"] != "plain"
        )
        for drive in drives
    ]
    measured, estimated = driven(None), driven("environment estimated")
    sharp = driven("environment estimated by sensors ten times as good")
    ratios = [one / other for one, other in zip(estimated, measured, strict=True)]
    rows = {"e measured": measured, "e estimated": estimated, "over measured": ratios}
    rows |= {
        "e estimated, sensors ten times as good": sharp,
        "without e, best row": untold,
    }
    page = (DOCS / "estimation.md").read_text("utf-8")
    lines = [
        [cell.strip("* ") for cell in line.strip("|").split("|")]
        for line in re.findall(r"^\|.*\|$", page, re.M)
    ]
    shown = {name: cells for name, *cells in lines}
    for name, values in rows.items():
        digits = 2 if name == "over measured" else 1
        assert shown.pop(name) == [f"{value:.{digits}f}" for value in values], name
    assert list(shown) == ["", "---"]
    gaps = [one - other for one, other in zip(untold, estimated, strict=True)]
    text = " ".join(page.split())
    assert f"the estimate costs {estimated[3] - measured[3]:.1f} mm on S3" in text
    assert f"the best by {gaps[3]:.1f} mm worse" in text
    assert f"{-gaps[2]:.1f} mm better" in text
    assert f"{gaps[0]:.0f} and {gaps[1]:.0f} mm below every row without e" in text


def test_what_the_fuzzer_found_is_what_the_page_says():
    """Every file was accepted or refused."""
    result = json.loads((ROOT / "benchmarks/robustness/fuzz.json").read_text())
    page = " ".join((DOCS / "failures.md").read_text("utf-8").split())
    accepted, refused = (
        sum(row.get(key, 0) for row in result["readers"].values())
        for key in ("accepted", "refused")
    )
    observed = f"accepted {accepted:_} files, refused {refused:_}, and found {len(result['faults'])} faults".replace(
        "_", " "
    )
    assert observed in page
    assert f"memory grew by {result['memory_MiB']['grown_by']} MiB" in page
    assert accepted + refused == result["cases"] == 100_000


def test_the_table_of_drills_is_that_of_the_run():
    """And nothing was damaged, failed or ended differently."""
    drills = json.loads((ROOT / "benchmarks/robustness/drills.json").read_text())
    table = drills_benchmark.table(drills)
    shown = (
        (DOCS / "failures.md")
        .read_text("utf-8")
        .split("<!-- drills -->")[1]
        .split("<!-- end of drills -->")[0]
    )
    assert shown.strip() == table
    assert table.endswith("| 0 | 0 | 0 |")
    args = {name: kills for name, (kills, *_) in drills["settings"]["jobs"].items()}
    assert {name: drills[name]["kills"] for name in args} == args
    assert sum(args.values()) == 200


def test_the_readme_says_of_the_corridor_what_its_page_says():
    """Every row of its table is one of that table, and the first sentence has both
    corridors, rounded.
    """
    page, readme = (
        file.read_text("utf-8") for file in (DOCS / "corridor.md", ROOT / "README.md")
    )
    rows = [
        text.split("<!-- corridor -->")[1].split("<!-- /corridor -->")[0].splitlines()
        for text in (readme, page)
    ]
    assert len(rows[0]) > 8
    assert set(rows[0]) <= set(rows[1])
    half = [
        json.loads(
            (PACKAGE / "pretrained" / f"{plant}_path" / "certificate.json").read_text()
        )["corridor"]["corridor_m"]
        for plant in ("dynamic", "kinematic")
    ]
    assert (
        f"within ±{half[0]:.2f} m (dynamic single track) or ±{half[1]:.2f} m (kinematic) "
        "of its path on at least 95 %" in " ".join(readme.split())
    )


def test_the_page_about_the_corridor_says_what_the_certificates_say():
    """Its table is what benchmarks/quality/corridor_page.py makes of the shipped certificates and
    the committed rows.
    """
    text = (DOCS / "corridor.md").read_text("utf-8")
    assert corridor_page.table() in text
    assert corridor_page.page(text) == text


def test_the_tables_about_speed_are_those_of_their_run():
    """Of the policies that ship, over the whole of their box; and it is the box that
    ends where the page says so.
    """
    measured = json.loads((ROOT / "benchmarks/quality/speed.json").read_text())
    text = (DOCS / "corridor.md").read_text("utf-8")
    assert speed_page.page(text, measured) == text
    for name, result in measured["cars"].items():
        certificate = json.loads(
            (PACKAGE / "pretrained" / f"{name}_path" / "certificate.json").read_text()
        )
        assert result["policy_sha256"] == certificate["policy_sha256"]
        about = certificate["corridor"]["class"]
        for key, ends in (
            ("speed", about["speed"]),
            ("friction", [side[0] for side in about["env_box"]]),
        ):
            values = {cell[key] for cell in result["cells"]}
            assert [min(values), max(values)] == ends


def test_the_page_about_path_coordinates_says_what_the_results_say():
    """Its tables are what benchmarks/quality/path_frame.py makes of the committed rows and
    tubes.
    """
    text = (DOCS / "results/path-frame.md").read_text("utf-8")
    assert [
        name
        for name, build in path_frame.TABLES.items()
        if f"<!-- {name} -->\n{build()}\n<!-- end -->" not in text
    ] == []


def test_the_tables_of_adaptation_are_those_of_its_runs():
    text = (DOCS / "adaptation.md").read_text("utf-8")
    assert adaptation_page.page(text) == text
    for name, table in adaptation_page.TABLES.items():
        assert table() in text, name


def test_the_tables_of_the_planner_are_those_of_its_runs():
    for name, tables in planner_page.PAGES.items():
        text = (DOCS / name).read_text("utf-8")
        assert planner_page.page(name) == text
        for marker, table in tables.items():
            assert table() in text, marker


def test_the_table_of_the_papers_terms_is_that_of_its_run():
    text = paper_terms_page.PAGE.read_text("utf-8")
    assert paper_terms_page.page() == text
    assert paper_terms_page.tables() in text


def test_the_tables_of_performance_are_those_of_its_runs():
    assert performance_page.page() == performance_page.PAGE.read_text("utf-8")


def test_the_table_of_what_protocol_2_can_tell_is_that_of_its_runs():
    text = protocol2_power.PAGE.read_text("utf-8")
    assert protocol2_power.page(text) == text
    assert protocol2_power.table() in text


def test_the_prose_of_adaptation_is_true_of_its_runs():
    cases = {name: adaptation_page.measured(name) for name in adaptation_page.VEHICLES}

    def ratio(vehicle, case, row="SFKD, adaptive", over="oracle that knows"):
        rows = cases[vehicle][case]
        return rows[row]["rmse_mm"] / rows[over]["rmse_mm"]

    for vehicle in cases:
        rows = cases[vehicle]["force, 3 s"]
        blind, own, best = (
            rows[row]["rmse_mm"]
            for row in ("SFKD", "SFKD, adaptive", "oracle that knows")
        )
        assert (blind - own) / (blind - best) > 0.8
        for case in ("mass + 30 %", "steering + 1 degree", "wheelbase + 5 %"):
            assert ratio(vehicle, case) <= 1.2
    assert round(ratio("dynamic", "stiffness - 30 %"), 2) == 1.25
    assert ratio("kinematic", "stiffness - 30 %") < 1.0
    bounds = {}
    for vehicle in cases:
        file = ROOT / f"benchmarks/quality/estimation_bound_{vehicle}.json"
        driven = json.loads(file.read_text())["rmse_mm"]
        wrong, right = (
            driven["oracle, e as wrong as the bound"],
            driven["oracle, e measured"],
        )
        bounds[vehicle] = round(wrong / right, 2)
    assert bounds == {"kinematic": 1.46, "dynamic": 1.05}
    for vehicle, leave in {"kinematic": 1, "dynamic": 0}.items():
        rows = cases[vehicle][adaptation_page.FRICTION]
        assert rows["oracle told late, cautious"]["left_the_lane"] == leave
    assert rows["SFKD, adaptive, cautious"]["left_the_lane"] == 0


def test_the_table_of_the_long_drive_is_that_of_its_run():
    """Every leg is there, and none failed at what is asked of all."""
    result = json.loads((ROOT / "benchmarks/robustness/soak.json").read_text())
    shown = (
        (DOCS / "failures.md")
        .read_text("utf-8")
        .split("<!-- soak -->")[1]
        .split("<!-- end of soak -->")[0]
    )
    assert shown.strip() == soak.table(result)
    assert result["legs"].keys() == soak.LEGS.keys()
    for leg in result["legs"].values():
        assert (
            leg["outside_limits"]
            == leg["not_finite"]
            == leg["compiled_later"]
            == leg["state_not_finite_after"]
            == 0
        )
        assert leg["compilations"] == 1
        assert leg["arrays"]["start"] == leg["arrays"]["end"]
        assert all(
            fault["until_healthy"]["never"] == 0 for fault in leg["faults"].values()
        )


def test_the_tables_of_the_shield_are_those_of_the_run():
    """And no car left its lane behind the shield."""
    measured = json.loads((ROOT / "benchmarks/quality/shield.json").read_text())
    table = shield_table.table(measured)
    shown = (
        (DOCS / "corridor.md")
        .read_text("utf-8")
        .split("<!-- shield -->")[1]
        .split("<!-- end of shield -->")[0]
    )
    assert shown.strip() == table.strip()
    rows = [
        row
        for car in measured["cars"].values()
        for row in (*car["scripts"].values(), car["planner"])
    ]
    assert not any(row["with"]["departures"] for row in rows)
    policies = {
        name: PACKAGE / "pretrained" / f"{name}_path" / "certificate.json"
        for name in measured["cars"]
    }
    for name, directory in policies.items():
        certificate = json.loads(directory.read_text())
        assert measured["cars"][name]["policy_sha256"] == certificate["policy_sha256"]
        assert measured["cars"][name]["bounds"] == certificate["corridor"]["bounds"]
