"""Definitions of services that rosbags does not come with, as in their packages' ``.srv`` files.

Comments, constants and default values are left out: the hash of a type does not depend on them.
An action is made of services and messages, as in https://design.ros2.org/articles/actions.html.
Sources: std_srvs and action_msgs of ROS 2 Jazzy, simulation_interfaces 2.1.0.
"""

from __future__ import annotations

SIMULATION = "simulation_interfaces/srv"
STEPS = "simulation_interfaces/action/SimulateSteps"
CANCEL_GOAL = "action_msgs/srv/CancelGoal"
TRIGGER = "std_srvs/srv/Trigger"
_ID = "unique_identifier_msgs/UUID goal_id\n"
_STAMP = "builtin_interfaces/Time stamp"

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
    f"{STEPS}_Goal": "uint64 steps",
    f"{STEPS}_Result": "Result result",
    f"{STEPS}_Feedback": "uint64 completed_steps\nuint64 remaining_steps",
    f"{STEPS}_FeedbackMessage": f"{_ID}{STEPS}_Feedback feedback",
    f"{STEPS}_SendGoal": f"{_ID}{STEPS}_Goal goal\n---\nbool accepted\n{_STAMP}",
    f"{STEPS}_GetResult": f"{_ID}---\nint8 status\n{STEPS}_Result result",
    CANCEL_GOAL: "GoalInfo goal_info\n---\nint8 return_code\nGoalInfo[] goals_canceling",
}
"""By type; request and response of a service are divided by ``---``."""
