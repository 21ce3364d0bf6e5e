"""The structure, as stated in ARCHITECTURE.md, held against the source text."""

import ast
import importlib.util
import os
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

FUNCTION = (ast.FunctionDef, ast.AsyncFunctionDef)
ROOT = Path(__file__).parents[1]
SRC = ROOT / "src" / "sfkd_jax"
PACKAGE = SRC.name
COMMANDS = {"generate", "train", "certify", "evaluate", "compare", "demo"}
COMMANDS |= {"collect"}
"""Modules that are commands alone; `export` and `report` are packages that run."""
CORE = {"info", "types", "geometry", "rollout", "ranges", "latency", "variables"}
GROUND = {
    "info": set(),
    "types": {"info"},
    "ranges": set(),
    "variables": set(),
    "geometry": {"types"},
    "rollout": {"types", "geometry"},
    "schedules": {"types"},
    "tables": set(),
    "latency": {"types", "geometry", "ranges"},
    "settings": {"ranges"},
    "store": set(),
    "certificate": {"ranges", "store"},
    "enclosures": set(),
    "models": CORE,
    "control": CORE,
    "progress": {"store"},
    "training": CORE | {"progress", "store"},
    "data": CORE,
    "evaluation": CORE,
    "certification": CORE | {"certificate", "data"},
    "systems": CORE | {"certificate", "control", "schedules", "tables"},
    "tubes": CORE
    | {"certificate", "certification", "enclosures", "progress", "systems"},
}
"""The floor for any system with an environment: package -> what it may import."""
ROAD = (
    CORE
    | {"schedules", "tables"}
    | {f"driving.{name}" for name in ("path_coordinates", "paths", "lanes", "sizes")}
)
PLANT = ROAD | {"driving.plants", "driving.scenarios"}
DRIVING = {
    "driving": set(),
    "driving.path_coordinates": {"types", "geometry"},
    "driving.sizes": set(),
    "driving.smoothing": set(),
    "driving.paths": {"types", "driving.smoothing"},
    "driving.lanes": {"types", "geometry", "driving.paths"},
    "driving.plants": ROAD,
    "driving.scenarios": ROAD,
    "driving.path_following": ROAD | {"control"},
    "driving.drives": PLANT | {"data", "store"},
    "driving.logs": PLANT | {"data", "store", "driving.path_following"},
    "driving.simulation": PLANT | {"evaluation"},
    "driving.certificate": {"ranges", "store", "certificate", "latency"},
    "driving.corridor": PLANT
    | {"certificate", "certification", "control", "data", "progress"}
    | {"driving.certificate", "driving.drives", "driving.path_following"},
}
"""The floor for vehicles along paths."""
PAPER = {"paper": ROAD | {"control", "models", "driving.path_following"}}
"""The floor of what only the paper needs."""
FLOORS = (GROUND, DRIVING, PAPER)
LIBRARIES = {name for floor in FLOORS for name in floor}
PARTS = LIBRARIES - {"training", "evaluation", "driving.simulation"}
APPLICATIONS = {
    "assembly": PARTS - {"certification", "driving.corridor"},
    "policy": PARTS | {"assembly"},
    "export": ROAD
    | {"assembly", "policy", "settings", "store"}
    | {"certificate", "certification"}
    | {"driving.certificate", "driving.path_following"},
    "adapters": PLANT | {"assembly", "policy", "systems"},
    "report": PLANT
    | {"assembly", "evaluation", "driving.simulation", "store"}
    | {"certificate", "driving.certificate"}
    | {"policy", "settings", "systems"},
    "viewer": ROAD
    | {"driving.certificate", "driving.plants", "driving.scenarios"}
    | {"driving.simulation", "policy", "report"},
    "__init__": {"export", "geometry", "info", "latency", "policy", "store", "systems"},
}
"""What puts the floors together."""
ARROWS = GROUND | DRIVING | PAPER | APPLICATIONS
ARROWS |= {"experiment": set(ARROWS)}
ARROWS["__init__"] |= {"experiment"}
ARROWS |= {name: set(ARROWS) for name in COMMANDS}
OF_CARS = ("lateral", "heading", "speed", "speeds", "road", "roads", "along_path")
OF_CARS += ("steering", "steer", "car", "cars")
"""Words that the ground floor does not know."""

ALLOWED_EVERYWHERE = set(sys.stdlib_module_names) | {PACKAGE, "jax", "jaxtyping"}
COMMAND_LINE = {"hydra", "omegaconf", "numpy"}
THIRD_PARTY = {
    "geometry": {"numpy"},
    "rollout": {"numpy"},
    "tables": {"numpy"},
    "latency": {"numpy"},
    "store": {"numpy", "filelock", "safetensors"},
    "models": {"flax"},
    "control": {"numpy"},
    "data": {"numpy"},
    "training": {"optax", "orbax"},
    "certificate": {"cryptography"},
    "certification": {"numpy", "scipy", "threadpoolctl", "cvxpy", "clarabel"},
    "evaluation": {"numpy", "scipy"},
    "enclosures": {"numpy"},
    "systems": {"numpy", "cvxpy"},
    "tubes": {"numpy"},
    "driving.path_coordinates": {"numpy"},
    "driving.smoothing": {"numpy", "scipy"},
    "driving.paths": {"numpy"},
    "driving.lanes": {"numpy"},
    "driving.plants": {"numpy"},
    "driving.path_following": {"numpy"},
    "driving.drives": {"numpy"},
    "driving.logs": {"numpy", "pyarrow", "pint"},
    "driving.simulation": {"numpy"},
    "driving.corridor": {"numpy", "scipy"},
    "paper": {"numpy"},
    "report": {"numpy", "pandas", "matplotlib", "PIL", "jinja2"},
    "viewer": {"numpy", "matplotlib", "viser"},
    "policy": {"huggingface_hub", "numpy"},
    "assembly": {"numpy"},
    "adapters": {"brax", "gymnasium", "matplotlib", "numpy", "scipy", "vehiclemodels"},
    "export": {"numpy", "iree"},
    "progress": {"tqdm"},
    "experiment": COMMAND_LINE | {"threadpoolctl", "yaml", "tensorboardX", "wandb"},
} | {command: COMMAND_LINE for command in COMMANDS}
HEAVY = {
    *("hydra", "omegaconf", "cvxpy", "clarabel", "orbax", "brax", "matplotlib"),
    *("optax", "pandas", "scipy", "pyarrow", "pint"),
}
"""What `import sfkd_jax.control` does not load."""
FOREIGN = {"brax", "mujoco", "gymnasium", "vehiclemodels", "huggingface_hub", "viser"}
"""What is loaded when its adapter, the Hub or the page of a drive is asked for."""

LONGEST_FILE = 400
"""Lines of a file of src, docstrings included."""
LONGEST_FUNCTION = 60
"""Lines of a function with everything inside it, less docstrings."""
PACKED = {"src": 40, "examples": 0}
"""Assignments of several values at once, of which one is called for."""
UNTYPED_SETTINGS = 0
"""Annotations `settings: dict[str, Any]` below the commands."""

TEXTS = {
    file.relative_to(SRC).as_posix(): file.read_text("utf-8")
    for file in SRC.rglob("*.py")
}
FILES = {name: ast.parse(text) for name, text in TEXTS.items()}


def package_of(parts: list[str]) -> str:
    """The package of a file or of an imported name, such as "driving.plants"."""
    inside = parts[0] == "driving" and len(parts) > 1 and parts[1] != "__init__"
    return ".".join(parts[: 2 if inside else 1])


PACKAGE_OF = {name: package_of(name.removesuffix(".py").split("/")) for name in FILES}
LIBRARY = [
    name
    for name in FILES
    if PACKAGE_OF[name] not in COMMANDS | {"experiment"}
    and not name.endswith("__main__.py")
]
"""Files below the commands."""
COMPILES = {"rollout", "policy", "training", "certification", "export", "data"}
COMPILES |= {"viewer"}
COMPILES |= {"systems", "tubes", "driving.corridor", "driving.drives", "driving.logs"}
"""Packages that run on the host, and may call `jax.jit`; so may gymnasium's adapter."""


def imports(name: str) -> Iterator[str]:
    """Absolute dotted names of all that a file imports, at any depth of its text."""
    package = ".".join((PACKAGE, *Path(name).parent.parts))
    for node in ast.walk(FILES[name]):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = importlib.util.resolve_name(
                "." * node.level + (node.module or ""), package
            )
            yield from (f"{base}.{alias.name}" for alias in node.names)


def own(name: str) -> Iterator[tuple[str, list[str]]]:
    """The imports from this package, as (package, parts of the name)."""
    for imported in imports(name):
        package, *rest = imported.split(".")
        if package == PACKAGE and rest != ["__version__"]:
            yield package_of(rest or ["__init__"]), rest


def nodes(name: str, *kinds: type) -> list:
    return [node for node in ast.walk(FILES[name]) if isinstance(node, kinds)]


def lines_of_code(function: ast.FunctionDef) -> int:
    """Lines of a function with everything inside it, less docstrings."""
    documented = [
        inner
        for inner in ast.walk(function)
        if isinstance(inner, FUNCTION) and ast.get_docstring(inner)
    ]
    docstrings = [inner.body[0] for inner in documented]
    taken = {line for d in docstrings for line in range(d.lineno, d.end_lineno + 1)}
    return len(set(range(function.lineno, function.end_lineno + 1)) - taken)


def fresh(code: str, **settings: str) -> str:
    """What a fresh process prints; it starts without the settings of the tests."""
    inherited = {
        name: value for name, value in os.environ.items() if not name.startswith("JAX_")
    }
    inherited.pop("PYTHONDONTWRITEBYTECODE", None)
    command = [sys.executable, "-c", code]
    done = subprocess.run(
        command, env=inherited | settings, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_file_has_a_package_and_follows_the_arrows():
    assert set(PACKAGE_OF.values()) <= set(ARROWS), "state the arrows of a new package"
    reached = {(name, package) for name in FILES for package, _ in own(name)}
    assert [
        pair
        for pair in sorted(reached)
        if pair[1] not in ARROWS[PACKAGE_OF[pair[0]]] | {PACKAGE_OF[pair[0]]}
        and not pair[0].endswith("__main__.py")
    ] == []


def test_no_floor_imports_one_above_it():
    below = set()
    for floor in FLOORS:
        below |= set(floor)
        assert {name: to - below for name, to in floor.items() if to - below} == {}


def test_the_ground_floor_knows_no_car():
    words = re.compile(rf"\b({'|'.join(OF_CARS)})\b", re.IGNORECASE)
    assert {
        f"{name}:{number}": line.strip()
        for name, text in TEXTS.items()
        if PACKAGE_OF[name] in GROUND
        for number, line in enumerate(text.splitlines(), 1)
        if words.search(line)
    } == {}


def test_packages_are_imported_through_their_public_names():
    assert [
        (name, rest)
        for name in FILES
        for package, rest in own(name)
        if package != PACKAGE_OF[name]
        and any(part.startswith("_") for part in rest[1:])
    ] == []


def test_third_party_packages_stay_where_they_belong():
    reached = {
        (name, imported.split(".")[0]) for name in FILES for imported in imports(name)
    }
    assert [
        (name, package)
        for name, package in sorted(reached)
        if package not in ALLOWED_EVERYWHERE | THIRD_PARTY.get(PACKAGE_OF[name], set())
    ] == []


def test_files_and_functions_stay_small():
    lengths = {name: len(text.splitlines()) for name, text in TEXTS.items()}
    assert {name: n for name, n in lengths.items() if n > LONGEST_FILE} == {}
    functions = [(name, node) for name in FILES for node in nodes(name, *FUNCTION)]
    sizes = [(name, node.name, lines_of_code(node)) for name, node in functions]
    assert [entry for entry in sizes if entry[2] > LONGEST_FUNCTION] == []


def packed(text: str) -> Iterator[int]:
    """Lines of assignments such as `a, b = f(x), g(y)`."""
    for node in ast.walk(ast.parse(text)):
        if (
            isinstance(node, ast.Assign)
            and isinstance(node.value, ast.Tuple)
            and any(isinstance(target, ast.Tuple) for target in node.targets)
            and any(isinstance(inner, ast.Call) for inner in ast.walk(node.value))
        ):
            yield node.lineno


def test_a_statement_assigns_one_thing():
    assert [*packed("a, b = f(x), 1\na, b = b, a\na, b = f(x)")] == [1]
    found = {
        folder: [
            f"{file.relative_to(ROOT)}:{line}"
            for file in (ROOT / folder).rglob("*.py")
            for line in packed(file.read_text("utf-8"))
        ]
        for folder in PACKED
    }
    assert {name: at for name, at in found.items() if len(at) > PACKED[name]} == {}


def test_settings_below_the_commands_have_types():
    found = Counter(
        name
        for name in LIBRARY
        for line in TEXTS[name].splitlines()
        if re.search(r"[sS]ettings: (dict|Mapping)\[str, Any\]", line)
    )
    assert found.total() <= UNTYPED_SETTINGS, found


def test_only_host_packages_compile():
    files = [name for name in LIBRARY if PACKAGE_OF[name] not in COMPILES]
    assert {
        name
        for name in files
        if "gymnasium" not in set(imports(name))
        and (
            {"jax.jit", "jax.pmap"} & set(imports(name))
            or any(
                ast.unparse(node) in ("jax.jit", "jax.pmap")
                for node in nodes(name, ast.Attribute)
            )
        )
    } == set()


def test_the_library_leaves_global_settings_alone():
    """Neither environment variables nor `jax.config`, but for one file that restores
    what it sets.
    """
    changes = re.compile(
        r"os\.environ\.(update|setdefault|pop)|os\.putenv|os\.environ\[.*\] ="
        r"|jax\.config"
    )
    found = {name for name in LIBRARY if changes.search(TEXTS[name])}
    assert len(found) <= 1, found
    assert all(PACKAGE_OF[name] == "export" for name in found)


@pytest.mark.parametrize(
    ("module", "kept_out"),
    [
        ("control", HEAVY | FOREIGN),
        ("policy", HEAVY - {"pandas"} | FOREIGN),
        ("adapters", FOREIGN),
        ("viewer", FOREIGN),
    ],
)
def test_a_module_is_imported_without_heavy_dependencies(module, kept_out):
    code = f"import sys, {PACKAGE}.{module}; print(*{{name.split('.')[0] for name in sys.modules}})"
    assert not kept_out & set(fresh(code).split())
