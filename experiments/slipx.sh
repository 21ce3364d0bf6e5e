#!/usr/bin/env bash
# From a 1/10 car that nobody here wrote to its corridor (docs/your-vehicle.md). The simulator is that of slipx
# (examples/slipx_car.py), whose grip and side force switch, and whose servo and tyres have states that no sensor
# shows. Its sensors are one step late. Beside the policy drive the law alone, MPPI with the textbook bicycle,
# Stanley's law and pure pursuit. The last line of the output is the line of slipx.json.
#
#     bash experiments/slipx.sh [--small] [root=DIR and other Hydra overrides]
name=slipx
seconds=(30 20)
vehicle=(vehicle.env=slipx_car:make 'environment.low=[0.5,-3]' 'environment.high=[1.1,3]')
policy=('dataset.law.points=[13,5,5]' 'latency.sensors=[0.05]')
estimated=()
. "$(dirname "$0")/_journey.sh"
