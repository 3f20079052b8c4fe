"""The IMU of a simulated vehicle: its model, fed from the physics."""

from __future__ import annotations

from typing import Any

import mujoco

from events import Imu, ImuAnnouncement
from events.frames import flip_yz, flip_yz_rotation
from events.rotations import rotate_inverse
from runtime import Node
from sims.sensors.imu import ImuModel, ImuParameters, Motion, mean_between, motion_at
from sims.sensors.sensor import generator_of
from sims.sensors.settings import SensorsConfig
from sims.vehicle import Physics, State


def mount_imu(world: mujoco.MjSpec, vehicle: str, parameters: ImuParameters) -> None:
    """Put the sensors of a vehicle's model where its IMU is, before the world is compiled."""
    if parameters.mounted:
        site = world.site(f"{vehicle}/imu")
        site.pos, site.quat = flip_yz(parameters.position), flip_yz_rotation(parameters.rotation)


class VehicleImu:
    """The IMU of one vehicle: its model, fed from the physics.

    Args:
        node: The vehicle's node.
        config: Settings of its sensors.
        physics: The vehicle, in a world that `mount_imu` has seen.
        frame_id: Frame of the body.
    """

    def __init__(
        self, node: Node[Any], config: SensorsConfig, physics: Physics, frame_id: str
    ) -> None:
        constants = generator_of(node.rng, "imu")
        self._model = ImuModel(config.imu, config.imu_rate, node.rng, constants)
        self._physics = physics
        self.source = f"{node.name}/imu"
        self._body = frame_id
        self._before: tuple[int, Motion] | None = None
        self._frame_id = self.announcement().frame_id

    def sample(self, stamp: int, state: State) -> Imu:
        """Return the measurement of the present, in a state of the same stamp."""
        parameters, physics = self._model.parameters, self._physics
        rates = state.angular_velocity
        _, force = physics.imu()  # between two steps the acceleration is constant
        if parameters.mounted:
            rates = rotate_inverse(parameters.rotation, rates)
        if parameters.sampling == "mean":
            motion = motion_at(
                parameters, state.orientation, state.velocity, state.angular_velocity
            )
            if self._before is not None and stamp > self._before[0]:
                seconds = (stamp - self._before[0]) / 1e9
                gravity = physics.parameters.gravity
                rates, force = mean_between(self._before[1], motion, seconds, gravity)
            self._before = stamp, motion
        rates, force = self._model.measure(rates, force, physics.thrusts)
        return Imu(
            stamp=stamp,
            source=self.source,
            frame_id=self._frame_id,
            angular_velocity=rates,
            linear_acceleration=force,
        )

    @property
    def mounted(self) -> bool:
        """Whether it has a frame of its own."""
        return self._model.parameters.mounted

    def announcement(self) -> ImuAnnouncement:
        """Return what the IMU will provide."""
        return self._model.announcement(self.source, self._body)
