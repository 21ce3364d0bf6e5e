"""The structure, as stated in ARCHITECTURE.md, held against the source text."""

import ast
import importlib.util
import os
import re
import statistics
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

FUNCTION = (ast.FunctionDef, ast.AsyncFunctionDef)
SRC = Path(__file__).parents[1] / "src" / "sfkd_jax"
PACKAGE = SRC.name
CORE = {"types", "geometry", "rollout", "ranges"}
COMMANDS = {
    "generate",
    "train",
    "certify",
    "evaluate",
    "compare",
    "report",
    "export",
    "doctor",
    "demo",
}
PLANT = CORE | {"plants"}
MODEL_AND_DATA = PLANT | {"store", "build", "certification", "control", "data"}
ARROWS = {
    "types": set(),
    "geometry": CORE,
    "rollout": CORE,
    "ranges": set(),
    "store": set(),
    "plants": CORE,
    "models": CORE,
    "control": CORE,
    "certification": CORE,
    "training": CORE | {"store"},
    "scenarios": PLANT,
    "data": PLANT | {"scenarios", "store"},
    "evaluation": PLANT | {"scenarios"},
    "build": PLANT | {"scenarios", "data", "models", "control"},
    "adapters": PLANT | {"scenarios", "build"},
    "policy": PLANT | {"store", "build", "certification", "control", "models"},
    "export": CORE | {"store", "build", "policy"},
    "corridor": MODEL_AND_DATA | {"evaluation", "policy"},
    "pipeline": MODEL_AND_DATA
    | {"corridor", "evaluation", "policy", "scenarios", "training"},
    "reporting": {"store", "evaluation"},
    "paper": {"store", "evaluation", "reporting"},
    "__init__": {"store", "export", "policy"},
}
LIBRARY = set(ARROWS)
ARROWS |= {"cli": LIBRARY}
ARROWS |= {command: LIBRARY | COMMANDS | {"cli"} for command in COMMANDS | {"__main__"}}

ALLOWED_EVERYWHERE = set(sys.stdlib_module_names) | {PACKAGE, "jax", "jaxtyping"}
COMMAND_LINE = {"hydra", "omegaconf", "numpy", "rich"}
THIRD_PARTY = {
    "store": {"numpy", "filelock"},
    "data": {"numpy", "pyarrow"},
    "models": {"flax"},
    "control": {"numpy"},
    "training": {"optax", "orbax", "tensorboardX", "rich"},
    "certification": {"numpy", "scipy", "threadpoolctl", "cvxpy", "clarabel"},
    "evaluation": {"numpy", "scipy"},
    "reporting": {"numpy", "matplotlib"},
    "policy": {"numpy"},
    "corridor": {"numpy"},
    "adapters": {
        "brax",
        "gymnasium",
        "matplotlib",
        "numpy",
        "scipy",
        "vehiclemodels",
    },
    "export": {"numpy", "iree"},
    "pipeline": {"numpy"},
    "paper": {"numpy", "matplotlib"},
    "cli": COMMAND_LINE | {"submitit"},
} | {command: COMMAND_LINE for command in COMMANDS | {"__main__"}}

FILES = {
    file.relative_to(SRC).as_posix(): ast.parse(file.read_text("utf-8"))
    for file in SRC.rglob("*.py")
}
PACKAGE_OF = {name: name.split("/")[0].removesuffix(".py") for name in FILES}
FOREIGN = {
    "brax": {"adapters/_brax.py", "adapters/_brax_system.py"},
    "gymnasium": {"adapters/_gymnasium.py"},
}
FOREIGN |= {"iree": {"export/_iree.py"}, "pyarrow": {"data/_tables.py"}}
FOREIGN |= {"vehiclemodels": {"adapters/_commonroad_equations.py"}}
HEAVY = {
    "hydra",
    "omegaconf",
    "cvxpy",
    "clarabel",
    "orbax",
    "brax",
    "matplotlib",
    "optax",
}
WRITES = {
    f"os.environ.{verb}" for verb in ("update", "setdefault", "pop", "popitem", "clear")
}
HOST = {"policy", "pipeline", "corridor", "training", "certification", "export"}
"""Besides the commands and gymnasium's adapter, where code runs on the host and may
compile.
"""
FORBIDDEN = WRITES | {"os.putenv", "os.unsetenv", "jax.config"}
GIVES_BACK = "export/_jax_settings.py"
"""The only library file that touches settings of jax: it sets them for one compilation
or export, and restores.
"""


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


def own(name: str) -> Iterator[list[str]]:
    """The imports from this package, as [room, the rest ...]; the version string
    belongs to no room.
    """
    for imported in imports(name):
        package, *rest = imported.split(".")
        if package == PACKAGE and rest != ["__version__"]:
            yield rest or ["__init__"]


def nodes(name: str, *kinds: type) -> list:
    return [node for node in ast.walk(FILES[name]) if isinstance(node, kinds)]


def lines_of_code(function: ast.FunctionDef) -> int:
    """Lines of a function with everything inside it, less docstrings."""
    documented = [
        f
        for f in ast.walk(function)
        if isinstance(f, FUNCTION) and ast.get_docstring(f)
    ]
    docstrings = [f.body[0] for f in documented]
    taken = {line for d in docstrings for line in range(d.lineno, d.end_lineno + 1)}
    return len(set(range(function.lineno, function.end_lineno + 1)) - taken)


def unannotated(function: ast.FunctionDef) -> bool:
    given = function.args
    arguments = [
        *given.posonlyargs,
        *given.args,
        *given.kwonlyargs,
        given.vararg,
        given.kwarg,
    ]
    bare = [
        a
        for a in arguments
        if a and a.annotation is None and a.arg not in ("self", "cls")
    ]
    return bool(bare) or function.returns is None


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
    assert FILES
    assert set(PACKAGE_OF.values()) <= set(ARROWS), (
        "state the new package's arrows here and in ARCHITECTURE.md"
    )
    reached = {(name, rest[0]) for name in FILES for rest in own(name)}
    assert (
        sorted(
            pair
            for pair in reached
            if pair[1] not in ARROWS[PACKAGE_OF[pair[0]]] | {PACKAGE_OF[pair[0]]}
        )
        == []
    )


def test_packages_are_imported_through_their_public_names():
    reached = [
        (name, rest)
        for name in FILES
        for rest in own(name)
        if rest[0] != PACKAGE_OF[name]
    ]
    assert [
        (name, rest)
        for name, rest in reached
        if any(part.startswith("_") for part in rest[1:])
    ] == []


def test_third_party_packages_stay_where_they_belong():
    reached = {
        (name, imported.split(".")[0]) for name in FILES for imported in imports(name)
    }
    allowed = {
        name: ALLOWED_EVERYWHERE | THIRD_PARTY.get(package, set())
        for name, package in PACKAGE_OF.items()
    }
    assert (
        sorted(
            (name, package) for name, package in reached if package not in allowed[name]
        )
        == []
    )


def test_foreign_interfaces_are_known_to_their_adapters_only():
    reached = {
        (imported.split(".")[0], name) for name in FILES for imported in imports(name)
    }
    assert {
        package: {name for result, name in reached if result == package}
        for package in FOREIGN
    } == FOREIGN


def test_files_and_functions_stay_small():
    lengths = {
        name: len((SRC / name).read_text("utf-8").splitlines()) for name in FILES
    }
    assert {name: length for name, length in lengths.items() if length > 300} == {}
    functions = [(name, node) for name in FILES for node in nodes(name, *FUNCTION)]
    sizes = [(name, node.name, lines_of_code(node)) for name, node in functions]
    assert [entry for entry in sizes if entry[2] > 80] == []
    assert statistics.median(size for _, _, size in sizes) <= 8


def test_the_top_level_stays_small():
    modules = {file.stem for file in SRC.glob("*.py")} - {"__init__"}
    assert modules == (COMMANDS - {"export"}) | CORE | {"policy", "__main__"}
    assert len(modules) <= 14


def test_the_old_private_words_are_gone():
    """Names of packages and identifiers that only this project understood."""
    root = SRC.parents[1]
    words = "shelf|hallway|rehears|assembly|itinerar|rooms|doors|finite_or_dear"
    gone = re.compile(rf"\b({words})", re.IGNORECASE)
    names = {"told", "met", "found", "place", "asked", "said", "pushed", "understood"}
    folders = ("src", "conf", "docs", "examples", "benchmarks", "experiments")
    files = [file for folder in folders for file in (root / folder).rglob("*")]
    files += [
        root / f"{name}.md" for name in ("README", "ARCHITECTURE", "CONTRIBUTING")
    ]
    for file in files:
        if file.suffix in (".py", ".md", ".yaml", ".toml", ".sh", ".html"):
            assert gone.findall(file.read_text("utf-8")) == [], file
    tokens = {
        (name, node.id if isinstance(node, ast.Name) else node.arg)
        for name in FILES
        for node in nodes(name, ast.Name, ast.arg)
    }
    assert sorted(pair for pair in tokens if pair[1] in names) == []


def test_public_functions_are_annotated():
    scopes = [(n, s) for n in FILES for s in (FILES[n], *nodes(n, ast.ClassDef))]
    functions = [
        (n, node)
        for n, scope in scopes
        for node in scope.body
        if isinstance(node, FUNCTION)
    ]
    assert [
        (n, f.name)
        for n, f in functions
        if not f.name.startswith("_") and unannotated(f)
    ] == []


def test_only_commands_and_host_packages_compile():
    library = [
        name
        for name in FILES
        if PACKAGE_OF[name] not in COMMANDS | HOST and name not in FOREIGN["gymnasium"]
    ]
    assert [
        name for name in library if {"jax.jit", "jax.pmap"} & set(imports(name))
    ] == []
    uses = [(name, node) for name in library for node in nodes(name, ast.Attribute)]
    assert [
        (n, node.lineno)
        for n, node in uses
        if ast.unparse(node) in ("jax.jit", "jax.pmap")
    ] == []


def test_the_library_leaves_global_settings_alone():
    library = [
        name
        for name in FILES
        if PACKAGE_OF[name] not in COMMANDS | {"cli"} and name != GIVES_BACK
    ]
    assert [
        name for name in library if (FORBIDDEN | {"os.environ"}) & set(imports(name))
    ] == []
    uses = [(name, node) for name in library for node in nodes(name, ast.Attribute)]
    assert [
        (n, node.lineno) for n, node in uses if ast.unparse(node) in FORBIDDEN
    ] == []
    items = [(name, node) for name in library for node in nodes(name, ast.Subscript)]
    written = [(n, node) for n, node in items if not isinstance(node.ctx, ast.Load)]
    assert [
        (n, node.lineno)
        for n, node in written
        if ast.unparse(node.value) == "os.environ"
    ] == []


@pytest.mark.parametrize(
    ("module", "kept_out"), [("control", HEAVY), ("policy", HEAVY - {"optax"})]
)
def test_a_controller_is_imported_without_heavy_dependencies(module, kept_out):
    if importlib.util.find_spec(f"{PACKAGE}.{module}") is None:
        pytest.skip("not built yet")
    code = f"import sys, {PACKAGE}.{module}; print(*{{name.split('.')[0] for name in sys.modules}})"
    assert not kept_out & set(fresh(code).split())


@pytest.mark.parametrize("module", [PACKAGE, f"{PACKAGE}.adapters"])
def test_a_foreign_package_is_loaded_when_its_adapter_is_asked_for(module):
    code = (
        f"import sys, {module}; print(*{{name.split('.')[0] for name in sys.modules}})"
    )
    assert not {"brax", "mujoco", "gymnasium", "vehiclemodels"} & set(
        fresh(code).split()
    )


@pytest.mark.parametrize(
    ("name", "package", "extra"),
    [
        ("BraxVehicle", "brax", "brax"),
        ("brax_plant", "brax", "brax"),
        ("GymnasiumVehicle", "gymnasium", "gym"),
        ("commonroad_vehicle", "vehiclemodels", "plants"),
    ],
)
def test_an_adapter_without_its_package_names_the_extra(name, package, extra):
    code = f"""
import sys
sys.modules["{package}"] = None
from {PACKAGE} import adapters
try:
    adapters.{name}
except ImportError as refusal:
    print(refusal)
"""
    assert (
        fresh(code).strip()
        == f'{PACKAGE}.adapters.{name} needs {package}: pip install "sfkd-jax[{extra}]"'
    )


def test_importing_the_controller_costs_little_beyond_jax(tmp_path):
    """Processor seconds, minimum over alternating fresh processes on one bytecode
    cache; a busy host needs more.
    """
    timed = "import time; start = time.process_time(); import {}; print(time.process_time() - start)"
    seconds: dict[str, list[float]] = {"jax": [], f"{PACKAGE}.control": []}
    for turn in range(15):
        for module, measured in seconds.items():
            measured.append(
                float(fresh(timed.format(module), PYTHONPYCACHEPREFIX=str(tmp_path)))
            )
        if turn >= 4 and min(seconds[f"{PACKAGE}.control"]) <= 1.3 * min(
            seconds["jax"]
        ):
            return
    assert min(seconds[f"{PACKAGE}.control"]) <= 1.3 * min(seconds["jax"])
