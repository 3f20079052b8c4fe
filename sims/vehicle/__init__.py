"""A quadrotor: its MuJoCo model, physics, control cascade and autopilot.

Everything here is pure: time is an argument, nothing waits, nothing is sent. One step of a run is

    physics.advance_to(stamp)
    state = physics.state()
    physics.set_motors(*autopilot.update(stamp, state, physics.touching()))
"""

from sims.vehicle.autopilot import Autopilot, Phase
from sims.vehicle.control import Controller, Motors, Setpoint
from sims.vehicle.motion import VehicleMotion
from sims.vehicle.physics import Contact, Physics, State
from sims.vehicle.position import Gains, Limits
from sims.vehicle.simulation import (
    STANDING_HEIGHT,
    TIMESTEP_NS,
    Mixer,
    Motor,
    PhysicsDivergedError,
    Simulation,
    VehicleParameters,
    attach_vehicle,
    read_parameters,
)

__all__ = [
    "STANDING_HEIGHT", "TIMESTEP_NS", "Autopilot", "Contact", "Controller", "Gains", "Limits",
    "Mixer", "Motor", "Motors", "Phase", "Physics", "PhysicsDivergedError", "Setpoint",
    "Simulation", "State", "VehicleMotion", "VehicleParameters", "attach_vehicle",
    "read_parameters",
]  # fmt: skip
