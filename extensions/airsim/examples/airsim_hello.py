"""The first script of everybody: take off, take an RGB and a depth image, land.

It is written for Cosys-AirSim's client and needs nothing of this project; see `airsim.toml`.
"""

from __future__ import annotations

import sys
from typing import Any

import cosysairsim as airsim
import numpy as np


def main(port: int = 41451) -> None:
    """Fly, and print the height, the image's mean colour and the wall's distance."""
    client: Any = airsim.MultirotorClient(port=port)
    client.confirmConnection()
    client.enableApiControl(True)
    client.armDisarm(True)
    client.takeoffAsync().join()

    rgb, depth = client.simGetImages(
        [
            airsim.ImageRequest("0", airsim.ImageType.Scene, False, False),
            airsim.ImageRequest("0", airsim.ImageType.DepthPlanar, True, False),
        ]
    )
    colours = np.frombuffer(rgb.image_data_uint8, np.uint8).reshape(rgb.height, rgb.width, 3)
    metres = np.array(depth.image_data_float).reshape(depth.height, depth.width)
    height = -client.getMultirotorState().kinematics_estimated.position.z_val
    print(
        f"{height:.2f} m up: {colours.shape[1]}x{colours.shape[0]} pixels, "
        f"mean colour {colours.mean(axis=(0, 1)).round().astype(int).tolist()}, "
        f"the wall is {metres[metres.shape[0] // 2, metres.shape[1] // 2]:.2f} m ahead"
    )

    client.landAsync().join()
    client.armDisarm(False)
    client.enableApiControl(False)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
