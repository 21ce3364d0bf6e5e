#!/usr/bin/env bash
# Trains SFKD along a path on both cars, certifies it with its corridor, and drives it on S3 inside its shield
# (docs/corridor.md). The policies that ship in src/sfkd_jax/pretrained/*_path were made by this. Extra arguments are
# Hydra overrides.
set -euo pipefail
for vehicle in dynamic kinematic; do
  if [ "$vehicle" = dynamic ]; then
    # The law of the experiment is that of the kinematic car. This car turns faster.
    of_vehicle=(
      dataset.segments=16000
      dataset.law.curvature_power=1.5 'dataset.law.perturbation=[0.008,1.0]'
      'dataset.steering_excitation=[0.0006,0.0065]'
    )
  else
    # Its steering saturates on ice, which needs more operators and more data.
    of_vehicle=(dataset.segments=64000 model.vertices=12)
  fi
  run=(
    +experiment=s3 vehicle="$vehicle" name="corridor_$vehicle"
    training.steps=20000 "${of_vehicle[@]}"
    certification.corridor.runs=300 certification.corridor.attack_steps=1000000
    'certification.corridor.later=[0.1,0.2,0.3]'
    evaluation.episodes=16 "$@"
  )
  python -m sfkd_jax.certify "${run[@]}"
  python -m sfkd_jax.evaluate "${run[@]}" controller=mppi_path_300
  # One sample is a law alone: of the learned model, the textbook bicycle, the true car, Stanley, pure pursuit.
  python -m sfkd_jax.evaluate "${run[@]}" controller=mppi_path_300 controller.mppi.num_samples=1 \
    'evaluation.systems=[law,law_nominal,law_plant,law_stanley,law_pure_pursuit]'
done
