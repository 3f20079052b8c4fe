"""A stand-in for an estimator on a companion computer: it says by MAVLink where the vehicle is.

Where it takes the vehicle's own telemetry, and makes it 1 % too long, a real one would look at
images. See `external_vision.toml`.
"""

from __future__ import annotations

import sys
from typing import Any

from pymavlink import mavutil


def main(address: str = "udpin:127.0.0.1:14540", silence: str = "10") -> None:
    """Answer each of the vehicle's poses with ``ODOMETRY``, until it is silent for some seconds."""
    vehicle: Any = mavutil.mavlink_connection(address, source_system=1, source_component=197)
    answered = 0
    while pose := vehicle.recv_match(type="ODOMETRY", blocking=True, timeout=float(silence)):
        vehicle.mav.odometry_send(
            pose.time_usec, pose.frame_id, pose.child_frame_id,
            1.01 * pose.x, 1.01 * pose.y, 1.01 * pose.z, pose.q,
            pose.vx, pose.vy, pose.vz, pose.rollspeed, pose.pitchspeed, pose.yawspeed,
            pose.pose_covariance, pose.velocity_covariance,
        )  # fmt: skip
        answered += 1
    print(f"{answered} poses")


if __name__ == "__main__":
    main(*sys.argv[1:])
