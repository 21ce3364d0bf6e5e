"""Settings of the rivals in path coordinates, chosen by their error on validation windows after a short training.

python -m benchmarks.quality.path_choices [--vehicle dynamic --steps 1000 --root runs --out
benchmarks/quality/path_choices.json] Every choice is trained by its own loss and scored by the
same: the free-running and the one-step prediction of the loss with its default weights.
What is in the JSON already is not trained again.
"""

import argparse
import json
import tempfile
from functools import partial
from pathlib import Path

import jax
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from sfkd_jax import build
from sfkd_jax.cli import config
from sfkd_jax.data import measure_space, random_windows, spread_windows
from sfkd_jax.pipeline import stages
from sfkd_jax.training import fit, multi_step_loss

CHOICES = {
    "neural_ode_path": [
        "training=standard",
        "training=state_model",
        "training=state_model training.learning_rate=0.001",
    ],
    "r2dn_path": [
        "training=standard",
        "training=path model.alpha=0.95",
        "training=path model.alpha=0.9",
    ],
    "sfkd_path_no_contraction": ["training=standard"],
}
"""Model -> overrides that are tried. A tube is in the loss of models that have one."""


def score(settings, steps):
    """Validation error after `steps` steps, and each of its two parts."""
    dataset, _ = stages.ensure_dataset(settings)
    options = dict(settings["training"]) | {"steps": steps, "save_every": steps}
    del options["data_share"]
    length, space = options.pop("window"), measure_space(dataset)
    model = build.build_model(
        settings["model"], space, build.build_vehicle(settings["vehicle"])
    )
    loss = multi_step_loss(model, space, **build.as_kwargs(options.pop("loss")))
    draw = partial(random_windows, batch=options.pop("batch"), length=length)
    held_out = spread_windows(dataset.validation, length=length)
    key = jax.random.fold_in(jax.random.key(settings["seed"]), 0)
    with tempfile.TemporaryDirectory() as directory:
        params, _ = fit(
            model, loss, draw, dataset.train, held_out, key, Path(directory), **options
        )
    parts = jax.jit(multi_step_loss(model, space))(params, held_out)[1]
    result = {name: float(parts[name]) for name in ("prediction", "one_step")}
    return {"error": sum(result.values())} | result


def main():
    """Train and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--vehicle", default="dynamic", choices=build.PLANTS)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--root", default="runs")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    args = parser.parse_args()
    config.register()
    saved = json.loads(args.out.read_text()) if args.out.exists() else {}
    for model, tried in CHOICES.items():
        for overrides in tried:
            name = f"{args.vehicle} {args.steps} {model} {overrides}"
            if name in saved:
                continue
            with initialize_config_dir(config.conf_path(), version_base="1.3"):
                picked = [
                    "dataset=path",
                    f"model={model}",
                    f"vehicle={args.vehicle}",
                    f"root={args.root}",
                ]
                composed = compose("config", overrides=[*picked, *overrides.split()])
            settings = OmegaConf.to_container(composed, resolve=True)
            saved[name] = score(settings, args.steps)
            print(name, saved[name], flush=True)
            args.out.write_text(json.dumps(saved, indent=1) + "\n")


if __name__ == "__main__":
    main()
