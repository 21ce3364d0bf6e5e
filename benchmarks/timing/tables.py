"""Markdown tables from the JSON files beside this script."""

import json
from pathlib import Path

from benchmarks.markdown import table

HERE = Path(__file__).parent
FILES = (
    "control_step",
    "scaling",
    "realtime",
    "plan_quality",
    "own_profile",
    "rows",
)
OWN = ("own_model", "own_model_ess", "own_model_sharded")
LABELS = {
    "sfkd_jax": "this library",
    "sfkd_jax_ess": "this library, temperature for 30 effective samples",
    "sfkd_jax_knots": "the same, noise of five bumps",
    "sfkd_jax_sharded": "this library, samples on two host devices",
    "plain_jax": "plain jax, written by hand",
    "jax_mppi": "jax_mppi, in one `jit`",
    "evosax_cma_es": "evosax, CMA-ES, one generation",
    "pytorch_mppi": "pytorch-mppi, eager",
    "pytorch_mppi_one_thread": "pytorch-mppi, one thread",
    "pytorch_kmppi": "pytorch-mppi, KMPPI, five points",
    "torchrl_mppi": "torchrl, one iteration",
    "tau_ctrl": "tau-ctrl, numpy",
    "own_model": "own model",
    "own_model_ess": "own model, temperature for 30 effective samples",
    "own_model_sharded": "own model, samples on two host devices",
}
STEP = {
    "best_ms": 1,
    "median_ms": 1,
    "p99_ms": 1,
    "cpu_ms": 1,
    "first_s": 1,
    "memory_mb": 0,
}
STEP_HEADS = (
    "best [ms]",
    "median [ms]",
    "p99 [ms]",
    "CPU [ms]",
    "first call [s]",
    "memory [MB]",
)
TAIL = {"p50_ms": 1, "p99_ms": 1, "p999_ms": 1, "max_ms": 1, "missed": 0, "steps": 0}
TAIL_HEADS = ("p50 [ms]", "p99 [ms]", "p99.9 [ms]", "max [ms]", "above 100 ms", "steps")


def read(name):
    """A document beside this script."""
    return json.loads((HERE / f"{name}.json").read_text())


def numbers(row, digits):
    """The entries of a row that are asked for."""
    return [f"{row[key]:.{count}f}" for key, count in digits.items()]


def steps(own):
    """One control step of the shared problem, or of the project's own model."""
    result = read("control_step")["contenders"]
    rows = [
        [LABELS[name], *numbers(row, STEP)]
        for name, row in result.items()
        if (name in OWN) == own
    ]
    return table(["contender", *STEP_HEADS], rows)


def ratios():
    """Every other contender's time over ours, on one device and on two."""
    result = read("control_step")["contenders"]
    kinds = [
        (ours, kind)
        for ours in ("sfkd_jax", "sfkd_jax_sharded")
        for kind in ("best_ms", "median_ms", "cpu_ms")
    ]
    heads = [
        "time over ours",
        *(f"{'two' if 'sh' in ours else 'one'}, {kind[:-3]}" for ours, kind in kinds),
    ]
    others = [
        name for name in result if not name.startswith("sfkd") and name not in OWN
    ]
    divided = lambda name: [
        f"{result[name][kind] / result[ours][kind]:.2f}" for ours, kind in kinds
    ]
    return table(heads, [[LABELS[name], *divided(name)] for name in others])


def left_out():
    """Contenders that did not run, and why."""
    return table(
        ["left out", "reason"],
        list(read("control_step")["not_run"].items()) or [["none", ""]],
    )


def sweep():
    """Best round's times by number of samples and by horizon."""
    result = read("scaling")
    names = list(result["exponents"])
    times = {
        (row["name"], row["samples"], row["horizon"]): row["best_ms"]
        for row in result["sweep"]
    }
    sizes = list(dict.fromkeys(key[1:] for key in times))
    entry = lambda name, size: (
        f"{times[name, *size]:.1f}" if (name, *size) in times else ""
    )
    rows = [
        [f"{size[0]} x {size[1]}", *(entry(name, size) for name in names)]
        for size in sizes
    ]
    for part, label in (
        ("all", "exponent in samples"),
        ("from_1500", "exponent from 1500 on"),
    ):
        rows.append(
            [
                label,
                *(
                    f"{result['exponents'][name].get(part, float('nan')):.2f}"
                    for name in names
                ),
            ]
        )
    return table(
        ["samples x horizon, best [ms]", *(LABELS[name] for name in names)], rows
    )


def compiling():
    """Seconds in a fresh process."""
    result = read("scaling")["compile"]
    digits = {"trace_s": 2, "compile_s": 2, "first_step_s": 3}
    rows = [
        [f"{name}, {kind} cache", *numbers(result[name][kind], digits)]
        for name in result
        for kind in result[name]
    ]
    return table(["", "trace [s]", "compile [s]", "first step [s]"], rows).replace(
        "cold cache", "no cache"
    )


def floor():
    """Episode against steps, and the roofline."""
    result = read("scaling")
    episode, under = result["episode"], result["floor"]
    rates = [under[f"{name}_gflops"] for name in ("step", "products", "large_product")]
    rows = [
        ["products of matrices alone", f"{under['products_ms']:.2f} ms"],
        ["tanh alone", f"{under['tanh_ms']:.2f} ms"],
        ["our step, same process", f"{under['step_ms']:.2f} ms"],
        [
            "step over floor, best / median",
            f"{under['ratio']:.2f} / {under['median_ratio']:.2f}",
        ],
        ["work in a step", f"{under['gflop']:.2f} GFLOP"],
        [
            "rate: step / its products / product of 1024",
            " / ".join(f"{rate:.0f}" for rate in rates) + " GFLOP/s",
        ],
        [
            f"episode of {episode['steps']} steps in one scan",
            f"{episode['episode_ms']:.0f} ms",
        ],
        ["the same over steps x step time", f"{episode['ratio']:.3f}"],
    ]
    return table(["", ""], rows)


def tails():
    """Thousands of steps, alone and beside a busy process."""
    result = read("realtime")["contenders"]
    kinds = {"alone": "alone", "beside": "beside a busy process"}
    rows = []
    for name, both in result.items():
        for kind, words in kinds.items():
            ran = "error" not in both[kind]
            rows.append(
                [
                    LABELS[name],
                    words,
                    *(numbers(both[kind], TAIL) if ran else [""] * len(TAIL)),
                ]
            )
    return table(["contender", "", *TAIL_HEADS], rows)


def closed_loop():
    """Cost of the closed loop for what fits into a budget of time."""
    rows = []
    for budget, result in read("plan_quality")["budgets"].items():
        for name, row in result.items():
            if not row["samples"]:
                rows.append([budget, LABELS[name], 0, "", "", "", ""])
                continue
            temperature = "found" if row["temperature"] is None else row["temperature"]
            cost = f"{row['cost']:.2f} ± {row['sd']:.2f}"
            rest = [
                cost,
                f"{row['worst_temperature_cost']:.2f}",
                f"{row['movement']:.3f}",
            ]
            rows.append([budget, LABELS[name], row["samples"], temperature, *rest])
    heads = [
        "budget [ms]",
        "contender",
        "samples",
        "best temperature",
        "cost",
        "at its worst one",
        "mean abs du",
    ]
    return table(heads, rows)


def profile():
    """Parts of the step with the project's own model."""
    shown = {"best_ms": 2, "median_ms": 2, "cpu_ms": 2}
    rows = [
        [label, *numbers(row, shown)]
        for label, row in read("own_profile")["parts"].items()
    ]
    return table(["part", "best [ms]", "median [ms]", "CPU [ms]"], rows)


def runs():
    """Under which settings, and beside how much other work, the files were made."""
    rows = []
    for name in FILES:
        if not (HERE / f"{name}.json").exists():
            continue
        result = read(name)
        args = ", ".join(
            f"{key} {value}" for key, value in result.get("settings", {}).items()
        )
        versions = ", ".join(
            f"{key} {value}" for key, value in result["machine"]["versions"].items()
        )
        load = result["machine"].get("load", "not recorded")
        load = load if isinstance(load, str) else f"{load:.1f}"
        rows.append([f"{name}.json", args, load, versions])
    return table(["file", "settings", "load average before", "versions"], rows)


def rows():
    """A control step of every row of sfkd-bench-2."""
    digits = {"best_ms": 1, "median_ms": 1, "cpu_ms": 1}
    lines = [
        [label, *numbers(row, digits)] for label, row in read("rows")["rows"].items()
    ]
    return table(["row", "best [ms]", "median [ms]", "CPU [ms]"], lines)
