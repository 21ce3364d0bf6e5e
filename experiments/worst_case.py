"""The tube of the worst case of a certified system: proved, or checked.

    python -m experiments.worst_case RUN SYSTEM [--out DIR] [--factor 2] [--seconds 600]
        [--size 1] [--first VARIABLE ...]
    python -m experiments.worst_case RUN SYSTEM [--out DIR] [--size 1] --check
        [--share 1]

RUN is the run directory of a system of examples/systems, such as SYSTEM = motor. States
are those of the box in which its shield makes claims, or of a smaller box of --size
times its widths around its middle; sensors are within three standard deviations. Every
cell is halved along the variables of --first before a bound is asked for. A line of
JSON for each output is printed, and kept in DIR beside the leaves that prove it:
OUTPUT.worst_case.json and OUTPUT.worst_case.npz.
"""

import argparse
import json
import runpy
import time
from dataclasses import asdict
from pathlib import Path

import jax
import numpy as np

import sfkd_jax
from sfkd_jax.systems import ClosedLoop, Tracked
from sfkd_jax.tubes import (
    OneStep,
    States,
    WorstCase,
    check_worst_case,
    prove_worst_case,
    sampled_worst,
)

EXAMPLES = Path(__file__).parents[1] / "examples" / "systems"
SIGMAS = 3.0
"""Standard deviations of a sensor that the tube allows for."""


def one_step(policy, system, frame, size=1.0):
    """The one-step error of a policy, where its shield makes claims.

    Args:
        policy: of the system.
        system: with its step.
        frame: of the system.
        size: of the box of states, relative to that of the claims.
    """
    loop = ClosedLoop(Tracked(system, frame), policy.loop.law)
    low, high = map(np.asarray, policy.certificate.measured.boxes.state)
    states = len(low)
    box = States(
        0.5 * (low + high), np.diag(0.5 * size * (high - low)), np.zeros((0, states))
    )
    noise = SIGMAS * np.asarray(system.sensor_noise)
    error = OneStep(loop, policy.model, policy.params, box, noise)
    # The noise acts through the law alone, which is linear in it.
    return OneStep(
        loop,
        policy.model,
        policy.params,
        box,
        noise,
        curved=tuple(range(error.variables - states)),
    )


def main():
    """Prove or check the tubes of all outputs, and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("system")
    parser.add_argument("--out", type=Path, default=None)
    parser.add_argument("--factor", type=float, default=2.0)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--first", type=int, nargs="*", default=())
    parser.add_argument("--size", type=float, default=1.0)
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--share", type=float, default=1.0)
    given = parser.parse_args()
    out = given.out or given.run
    policy = sfkd_jax.load(given.run)
    made = runpy.run_path(str(EXAMPLES / f"{given.system}.py"))["make"]()
    error = one_step(policy, *made, size=given.size)
    for name, claim in policy.certificate.proof.outputs.items():
        path = out / f"{name}.worst_case.npz"
        began = time.process_time()
        if given.check:
            tube = WorstCase(**json.loads(path.with_suffix(".json").read_text()))
            codes = np.load(path)["codes"]
            check_worst_case(error, claim, tube, codes, share=given.share)
            seconds = time.process_time() - began
            print(json.dumps({"output": name, "holds": True, "cpu_s": seconds}))
            continue
        sampled, _, _ = sampled_worst(error, claim, jax.random.key(0))
        print(f"{name}: sampled {sampled:.4g}", flush=True)
        tube, codes = prove_worst_case(
            error,
            claim,
            sampled,
            factor=given.factor,
            seconds=given.seconds,
            first=tuple(given.first),
            told=lambda line: print(line, flush=True),
        )
        out.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(path, codes=codes)
        path.with_suffix(".json").write_text(json.dumps(asdict(tube), indent=2))
        seconds = time.process_time() - began
        print(json.dumps({"output": name, **asdict(tube), "cpu_s": seconds}))


if __name__ == "__main__":
    main()
