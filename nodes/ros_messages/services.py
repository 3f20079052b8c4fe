"""Definitions of services that rosbags does not come with, as in their packages' ``.srv`` files.

Comments, constants and default values are left out: the hash of a type does not depend on them.
Sources: std_srvs of ROS 2 Jazzy, simulation_interfaces 2.1.0.
"""

from __future__ import annotations

SIMULATION = "simulation_interfaces/srv"
TRIGGER = "std_srvs/srv/Trigger"

DEFINITIONS = {
    TRIGGER: "---\nbool success\nstring message",
    "simulation_interfaces/msg/Result": "uint8 result\nstring error_message",
    "simulation_interfaces/msg/SimulationState": "uint8 state",
    "simulation_interfaces/msg/SimulatorFeatures": (
        "uint16[] features\nstring[] spawn_formats\nstring custom_info"
    ),
    f"{SIMULATION}/GetSimulatorFeatures": "---\nSimulatorFeatures features",
    f"{SIMULATION}/GetSimulationState": "---\nSimulationState state\nResult result",
    f"{SIMULATION}/SetSimulationState": "SimulationState state\n---\nResult result",
    f"{SIMULATION}/StepSimulation": "uint64 steps\n---\nResult result",
    f"{SIMULATION}/ResetSimulation": "uint8 scope\n---\nResult result",
}
"""By type; request and response of a service are divided by ``---``."""
