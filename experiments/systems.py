"""What experiments/systems.sh finds: systems that are no cars, certified and compared.

    python -m experiments.systems ROOT [--small] [--write] [NAME ...]

Every system of examples/systems is certified in ROOT/NAME, which is continued where it
stopped, and then driven beside its law, an oracle and a nominal model. A system of a
publication that says from where it starts, as c3m/pvtol does, starts from there too.
An example may have `SETTINGS` of its own for `certify_system`.
Its line of JSON is printed and kept in ROOT/NAME/line.json, that of --small in
small.json. With --write the lines in ROOT become experiments/systems.json.
"""

import argparse
import json
import runpy
import time
from pathlib import Path

import jax
import numpy as np

from benchmarks import as_lines, stamp
from sfkd_jax.certification import CertificationRefused
from sfkd_jax.experiment.system_runs import (
    compared,
    drive_beside_rivals,
    random_scenes,
    run_controller,
)
from sfkd_jax.experiment.systems import certify_system
from sfkd_jax.systems import NoLaw

EXAMPLES = Path(__file__).parents[1] / "examples" / "systems"
FILES = [*sorted(EXAMPLES.glob("*.py")), *sorted(EXAMPLES.glob("*/*.py"))]
SYSTEMS = tuple(file.relative_to(EXAMPLES).with_suffix("").as_posix() for file in FILES)
RESULTS = Path(__file__).with_suffix(".json")
STARTS = 200
"""Number of starts of a publication."""
BACK = 0.5
"""Time at the end of a run over which a system is back at its reference [s]."""
SMALL = {"steps": 500, "segments": 0.3, "runs": 60, "duration": 10.0}
"""Settings of `certify_system` in small size; in full size they are its defaults."""
SMALL_SYSTEMS = "quadrotor", "cart_pole"
SMALL_COMPARISON = {"runs": 4, "duration": 10.0}
"""Settings of `drive_beside_rivals` in small size."""
DIGITS = 4
"""Significant digits of the numbers of a line."""


def rounded(value):
    """A document whose numbers have few digits."""
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}")
    if isinstance(value, dict):
        return {name: rounded(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(entry) for entry in value]
    return value


def share_back(policy, system, starts, *, duration, runs=STARTS):
    """Share of the starts of a publication from which a policy reaches its reference.

    A run is back if all outputs are within their whole bounds in its last `BACK` s.

    Args:
        policy: of the system.
        system: with its step.
        starts: state -> ends of the errors at the start.
        duration: of a run [s].
        runs: number of starts.
    """
    scene_key, start_key, drive_key = jax.random.split(jax.random.key(2), 3)
    scenes = random_scenes(policy, scene_key, runs=runs, duration=duration)
    low, high = np.asarray([starts.get(name, (0, 0)) for name in system.state_names]).T
    away = jax.random.uniform(start_key, scenes.start.shape, minval=low, maxval=high)
    driven = run_controller(
        policy,
        system.step,
        policy.controller,
        policy.params,
        scenes._replace(start=scenes.start + away),
        drive_key,
    )
    totals = [bound.total for bound in policy.certificate.tubes.outputs.values()]
    last = np.asarray(driven.errors[:, -round(BACK / system.dt) :])
    return float(np.mean(np.all(last <= totals, axis=(1, 2))))


def line_of(name, directory, *, settings, comparison):
    """Certify a system, compare its policy, and return its line.

    Args:
        name: of the example.
        directory: of the run.
        settings: of `certify_system`.
        comparison: settings of `drive_beside_rivals`.
    """
    began = time.perf_counter()
    example = runpy.run_path(str(EXAMPLES / f"{name}.py"))
    system, frame = example["make"]()
    line = {"system": name, "states": len(system.states)}
    own = example.get("SETTINGS", {})
    try:
        policy = certify_system(system, frame, root=directory, **own, **settings)
    except (NoLaw, CertificationRefused) as reason:
        return line | {"refused": str(reason)}
    minutes = (time.perf_counter() - began) / 60.0
    tubes = policy.certificate.tubes
    units = policy.model.frame.units
    back = {}
    if "STARTS" in example:
        back["back"] = share_back(
            policy, system, example["STARTS"], duration=example["DURATION"]
        )
    return {
        **line,
        "alpha": policy.certificate.proof.alpha,
        "tube": {output: bound.tube for output, bound in tubes.outputs.items()},
        "total": {output: bound.total for output, bound in tubes.outputs.items()},
        "law": {output: bound.system for output, bound in tubes.outputs.items()},
        "unit": {output: units[output] for output in tubes.outputs},
        "coverage": tubes.coverage.share,
        "coverage_ci95": tubes.coverage.ci95,
        **compared(drive_beside_rivals(policy, system, **comparison)),
        **back,
        # Of the certificate, if it was not interrupted.
        "minutes": minutes,
    }


def main():
    """Print a line for every system."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("root", type=Path, help="folder of the runs")
    parser.add_argument("names", nargs="*", help=f"of {', '.join(SYSTEMS)}")
    parser.add_argument("--small", action="store_true", help="two systems, small sizes")
    parser.add_argument("--write", action="store_true", help=f"write {RESULTS.name}")
    given = parser.parse_intermixed_args()
    names = given.names or (SMALL_SYSTEMS if given.small else SYSTEMS)
    if unknown := set(names) - set(SYSTEMS):
        parser.error(f"{', '.join(unknown)}: systems are {', '.join(SYSTEMS)}")
    for name in names:
        directory = given.root / name
        file = directory / ("small.json" if given.small else "line.json")
        if not file.is_file():
            line = line_of(
                name,
                directory,
                settings=SMALL if given.small else {},
                comparison=SMALL_COMPARISON if given.small else {"runs": 8},
            )
            directory.mkdir(parents=True, exist_ok=True)
            file.write_text(json.dumps(rounded(line) | stamp()), "utf-8")
        print(file.read_text("utf-8"), flush=True)
    if given.write:
        files = [given.root / name / "line.json" for name in SYSTEMS]
        lines = [json.loads(file.read_bytes()) for file in files if file.is_file()]
        RESULTS.write_text(f"{as_lines(lines)}\n", "utf-8")


if __name__ == "__main__":
    main()
