#!/usr/bin/env bash
# From a simulator that nobody here wrote to a car in its corridor (docs/your-vehicle.md). The simulator is the
# dynamic bicycle of highway-env (examples/highway.py), whose grip and side force switch. Beside the policy, the
# same policy drives with grip and force estimated, and so do its law alone, MPPI with the textbook bicycle, Stanley's
# law and pure pursuit, whose constants are chosen on this car. The last line of the output is the line of simulator.json.
#
#     bash experiments/simulator.sh [--small] [root=DIR and other Hydra overrides]
name=highway
seconds=(60 30)
vehicle=(vehicle.env=highway:make 'environment.low=[0.35,-3]' 'environment.high=[1,3]' scaled=false)
policy=(
  'dataset.speed=[8,11]' 'dataset.law.speed=[8,11]' 'dataset.law.points=[13,3,5]'
  # The settings with which the line of simulator.json was made.
  dataset.law.lateral=10 dataset.law.heading=60 'training.loss.tube=[0.05]'
)
# A force acts as it is (power 1), a wind by its square. The model's errors are those of open_loop.json.
estimated=(
  environment.source=estimated controller.adaptation.power=1
  '+controller.adaptation.model_error=[9e-4,2e-4,6e-3,7e-3,4e-3]'
)
. "$(dirname "$0")/_journey.sh"
