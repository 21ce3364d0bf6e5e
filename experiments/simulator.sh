#!/usr/bin/env bash
# From a simulator that nobody here wrote to a car in its corridor (docs/your-vehicle.md). The simulator is the
# dynamic bicycle of highway-env (examples/highway.py), whose grip and side force switch. Beside the policy, the
# same policy drives with grip and force estimated, and so do MPPI with the textbook bicycle, Stanley's law and
# pure pursuit, whose constants are chosen on this car. The last line of the output is the line of simulator.json.
#
#     bash experiments/simulator.sh [--small] [root=DIR and other Hydra overrides]
set -euo pipefail
export PYTHONPATH=${PYTHONPATH:-src}:.:examples
root=runs
size=(
  dataset.segments=4000 training.steps=6000
  certification.corridor.runs=150
  evaluation.episodes=40 evaluation.episode_s=60
)
if [ "${1:-}" = --small ]; then
  shift
  size=(
    dataset.segments=1500 training.steps=1500
    certification.corridor.runs=40 certification.corridor.duration=20
    evaluation.episodes=6 evaluation.episode_s=30
  )
fi
for word in "$@"; do
  case $word in root=*) root=${word#root=} ;; esac
done
car=(
  vehicle=simulator vehicle.env=highway:make
  'environment.low=[0.35,-3]' 'environment.high=[1,3]' scaled=false
  "${size[@]}"
)
path=(
  +experiment=s3 name=highway "${car[@]}"
  'dataset.speed=[8,11]' 'dataset.law.speed=[8,11]' 'dataset.law.points=[13,3,5]'
  # The settings with which the line of simulator.json was made.
  dataset.law.lateral=10 dataset.law.heading=60 'training.loss.tube=[0.05]'
  certification.corridor.attack_steps=20000 controller=mppi_path_300
)
python -m sfkd_jax.train "${path[@]}" 'evaluation.systems=[self]' "$@"
# A force acts as it is (power 1), a wind by its square. The model's errors are those of open_loop.json.
python -m sfkd_jax.evaluate "${path[@]}" 'evaluation.systems=[self]' environment.source=estimated \
  controller.adaptation.power=1 '+controller.adaptation.model_error=[9e-4,2e-4,6e-3,7e-3,4e-3]' "$@"
python -m sfkd_jax.evaluate "${path[@]}" controller.mppi.num_samples=1 \
  'evaluation.systems=[law_stanley,law_pure_pursuit]' "$@"
python -m sfkd_jax.evaluate +experiment=s3_body name=highway_nominal "${car[@]}" 'evaluation.systems=[nominal]' "$@"
python -m experiments.simulator "$root" highway
