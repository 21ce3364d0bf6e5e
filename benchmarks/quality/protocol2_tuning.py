"""Tune every trained row of sfkd-bench-2 with one budget, on validation drives alone.

python -m benchmarks.quality.protocol2_tuning [--vehicles dynamic --rows sfkd … --root runs]
A row has 8 trials of 1000 steps on each plant: its own settings, then seven that a
scrambled Sobol sequence draws from `SPACES`. A trial is a run of +experiment=tune. The
best prediction loss on validation drives of S1 and S2 wins; nothing is driven. Trials
that are stored are not repeated. Writes protocol2_trials/VEHICLE/ROW.json, and with --choose
conf/comparison/tuned.yaml from all of them.
"""

import argparse
import json
import math
import sys
from pathlib import Path
from typing import NamedTuple

import jax
import yaml
from hydra import compose, initialize_config_dir
from scipy.stats import qmc

from sfkd_jax import policy, store, train
from sfkd_jax.cli.config import conf_path, plain_settings, register
from sfkd_jax.training import TrainingStopped

TRIALS = 8
STEPS = 1000
SEED = 1000
"""Of the trials' weights and windows; the rows themselves use 0, 1 and 2."""
VEHICLES = ("kinematic_stiff", "dynamic")
SAME_STATES = {"kinematic": "kinematic_stiff"}
"""A plant that takes the settings of another one with the same states."""
HERE = Path(__file__).parent
TUNED = HERE.parents[1] / "conf" / "comparison" / "tuned.yaml"


class Range(NamedTuple):
    """A setting that is drawn evenly on a logarithmic scale, to two digits."""

    low: float
    high: float

    def at(self, share):
        """The value at a share of the range."""
        return float(f"{self.low * (self.high / self.low) ** share:.2g}")


class Choice(NamedTuple):
    """A setting that is one of several."""

    values: tuple

    def at(self, share):
        """The value at a share of the list."""
        return self.values[min(int(share * len(self.values)), len(self.values) - 1)]


TRAINING = {
    "training.learning_rate": Range(1e-3, 2e-2),
    "training.loss.one_step": Range(0.1, 10.0),
    "training.loss.consistency": Range(1e-4, 0.1),
}
OWN_LIFT = {
    "model.rank": Choice((24, 32, 40)),
    "model.decoder_hidden": Choice(("[48,32]", "[64,32]", "[80,32]")),
}
NETWORK = {"model.hidden": Choice(("[80,80]", "[96,96]", "[112,112]"))}
SPACES = {
    "sfkd": OWN_LIFT,
    "r2dn": OWN_LIFT,
    "neural_ode": NETWORK,
    "icode": {"model.width": Choice((48, 60, 72))},
    "icode_mppi": {"model.hidden": Choice(("[52,52]", "[64,64]", "[76,76]"))},
    "control_synth": {"model.width": Choice((36, 48, 60))},
    "koopman_mpc": {
        "model.functions": Choice((60, 100, 150)),
        "model.environment_degree": Choice((1, 2, 3)),
        "model.heading_range": Range(0.25, 1.0),
        "model.lateral_range": Range(2.0, 8.0),
    },
}
"""Factory -> what is searched of the model; gradient descent has `TRAINING` besides."""


def space_of(settings):
    """The settings that are searched for a row."""
    name = settings["model"]["name"]
    space = {} if name == "koopman_mpc" else dict(TRAINING)
    if settings["training"]["loss"]["prediction"] == 0.0:
        del space["training.loss.one_step"]  # the only term that is left
    return space | SPACES[name]


def trials_of(space):
    """The settings of all trials as lists of overrides; the first changes nothing."""
    draws = qmc.Sobol(len(space), seed=SEED).random(TRIALS)[1:]
    return [[]] + [
        [
            f"{key}={part.at(share)}"
            for (key, part), share in zip(space.items(), draw, strict=True)
        ]
        for draw in draws
    ]


def settings_of(*overrides):
    """The settings that a command would have with these overrides."""
    register()
    with initialize_config_dir(conf_path(), version_base="1.3"):
        return plain_settings(compose("config", overrides=list(overrides)))


def composed(root, name, vehicle, row, overrides):
    """The settings of a trial."""
    return settings_of(
        "+experiment=tune",
        f"root={root}",
        f"name={name}",
        f"vehicle={vehicle}",
        f"seed={SEED}",
        f"training.steps={STEPS}",
        *row.split(),
        *overrides,
    )


def tune(root, vehicle, label, row):
    """Run the trials of a row that are missing, and write all of them."""
    out = HERE / "protocol2_trials" / vehicle / f"{label}.json"
    planned = trials_of(space_of(composed(root, "any", vehicle, row, [])))
    trials = stored(out, row, planned)
    for number, overrides in list(enumerate(planned))[len(trials) :]:
        name = f"tune/{vehicle}/{label}/{number}"
        settings = composed(root, name, vehicle, row, overrides)
        trial = {"overrides": overrides, "score": None}
        try:
            document = train.run(settings)
            weights = policy.restore(Path(document["run"])).params
            trial["score"] = document["objective"]
            trial["parameters"] = sum(leaf.size for leaf in jax.tree.leaves(weights))
        except (ValueError, TrainingStopped) as reason:
            trial["failed"] = str(reason)
        trials.append(trial)
        out.parent.mkdir(parents=True, exist_ok=True)
        store.write_json(out, about(row) | {"trials": trials})
        print(f"{vehicle} {label} {trial}", file=sys.stderr, flush=True)


def about(row):
    """What all trials of a row have in common."""
    return {"row": row, "seed": SEED, "steps": STEPS}


def stored(file, row, planned):
    """The trials of a row that were made.

    Raises:
        SystemExit: they are of another row, budget or search.
    """
    if not file.exists():
        return []
    document = store.read_json(file, keys=("trials",))
    trials = document.pop("trials")
    overrides = [trial["overrides"] for trial in trials]
    if document != about(row) or overrides != planned[: len(trials)]:
        raise SystemExit(f"{file}: trials of another row, budget or search")
    return trials


def rows_of(experiment, data=""):
    """Label -> overrides of the rows of a comparison that are trained."""
    comparison = settings_of(f"+experiment={experiment}")["comparison"]
    return {
        label: data + row
        for label, row in comparison["rows"].items()
        if label not in comparison["untrained"]
    }


def trained_rows():
    """Label -> overrides of every row that is tuned, in both frames."""
    path = rows_of("protocol2_path", "dataset=path controller=mppi_path ")
    return rows_of("protocol2") | path


def chosen(document):
    """The overrides of the best trial."""

    def score(trial):
        value = trial["score"]
        return value if value is not None and math.isfinite(value) else math.inf

    best = min(document["trials"], key=score)
    if math.isinf(score(best)):
        raise SystemExit(f"no trial of {document['row']} has a score")
    return " ".join(best["overrides"])


def winners():
    """Vehicle -> row -> the overrides of its best trial."""
    tuned = {}
    for file in sorted((HERE / "protocol2_trials").glob("*/*.json")):
        document = json.loads(file.read_text())
        if len(document["trials"]) < TRIALS:
            raise SystemExit(f"{file}: {len(document['trials'])} of {TRIALS} trials")
        found = tuned.setdefault(file.parent.name, {})
        if best := chosen(document):  # otherwise the row keeps its own settings
            # A row takes its settings without e as well.
            found |= dict.fromkeys((file.stem, f"{file.stem}_blind"), best)
    return tuned | {vehicle: tuned[like] for vehicle, like in SAME_STATES.items()}


def choose():
    """Write the best trials as the settings of the comparison."""
    head, *_ = TUNED.read_text("utf-8").splitlines()
    text = yaml.safe_dump({"tuned": winners()}, width=200)
    TUNED.write_text(f"{head}\n{text}", "utf-8")


def main():
    """Parse, then tune or choose."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    rows = trained_rows()
    parser.add_argument("--vehicles", nargs="*", default=VEHICLES)
    parser.add_argument("--rows", nargs="*", choices=rows, default=list(rows))
    parser.add_argument("--root", default="runs")
    parser.add_argument("--choose", action="store_true")
    given = parser.parse_args()
    if given.choose:
        return choose()
    for label in given.rows:
        for vehicle in given.vehicles:
            tune(given.root, vehicle, label, rows[label])
    return None


if __name__ == "__main__":
    main()
