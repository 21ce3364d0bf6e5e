#!/usr/bin/env bash
# SFKD along a path on both plants: trained, certified with its corridor, driven on S3 inside its shield (docs/corridor.md).
# What ships in src/sfkd_jax/pretrained/*_path was made by this. Extra arguments are Hydra overrides.
set -euo pipefail
for vehicle in dynamic kinematic; do
  # Its steering saturates on ice: more operators, more data.
  [ "$vehicle" = dynamic ] && own=(dataset.segments=16000) || own=(dataset.segments=64000 model.vertices=12)
  run=(+experiment=s3 vehicle="$vehicle" name="corridor_$vehicle" training.steps=20000 "${own[@]}"
    certification.corridor.runs=300 certification.corridor.attack_steps=1000000 evaluation.episodes=16 "$@")
  python -m sfkd_jax.certify "${run[@]}"
  python -m sfkd_jax.evaluate "${run[@]}" controller=mppi_path_300
  # The law alone: of the learned model, of the textbook bicycle, of the true car; Stanley, pure pursuit.
  python -m sfkd_jax.evaluate "${run[@]}" controller=mppi_path_300 controller.mppi.num_samples=1 'evaluation.systems=[law,law_nominal,law_plant,law_stanley,law_pure_pursuit]'
done
