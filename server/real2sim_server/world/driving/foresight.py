"""Where the vehicle will be when a command that is given now reaches its wheels.

Trackers that know of dead times decide for that state (a Smith predictor without model error), so
that a loop with dead time is as stable as the one without.
"""

from __future__ import annotations

from ..._numba import func
from .actuators import actuator_outputs
from .vehicle_models import step_vehicle


@func
def foreseen_state(state, queue, vehicle, h, substeps):
    """The vehicle some substeps later, under the commands that are on their way.

    Args:
        state: of the vehicle.
        queue: line of commands and how many of its rows are in use.
        vehicle: constants.
        h: length of a substep [s].
        substeps: how many.
    """
    for k in range(substeps):
        outputs = actuator_outputs(queue, state, vehicle, h, k + 1)
        state = step_vehicle(vehicle.model, state, outputs, vehicle, h)
    return state
