"""Settings of `AirsimClient`."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from runtime import Duration, NodeConfig

Rate = Annotated[float, msgspec.Meta(gt=0, le=1000)]
Kind = Literal["rgb", "depth", "segmentation"]


class RemoteCamera(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A camera of the server's vehicle; its size, field of view and mount come from the server.

    Attributes:
        name: As the server has it: ``0``, ``front_center``.
        images: What is asked for. Segmentation is asked for as the type "infrared", whose grey
            level is the object's ID.
    """

    name: Annotated[str, msgspec.Meta(min_length=1)]
    images: tuple[Kind, ...] = ("rgb", "depth")

    def __post_init__(self) -> None:
        if not self.images or len(set(self.images)) != len(self.images):
            raise ValueError(f"images: expected one or more kinds, each once, found {self.images}")


class AirsimClientConfig(NodeConfig):
    """Settings of the client.

    Attributes:
        host: Where the server is.
        port: The server's.
        vehicle: Name that the vehicle has there; empty for the first by name.
        flavour: Whose server it is: ``airsim`` (and Colosseum's), ``cosys``, or ``auto``: by the
            version that the server reports.
        cameras: The cameras whose images are asked for; if none is given, those of the server's
            settings, or else the camera ``0``.
        image_rate: Sets of images per second; in real time at most so many.
        imu_rate: Samples of the IMU and of the true state per second; in lockstep also steps.
        control_rate: Rate at which the newest set-point is sent, Hz.
        takeover: Whether it takes API control and passes on commands and set-points; if not,
            somebody else flies.
        setpoint_timeout: Age beyond which a set-point is ignored, unless it is one of position.
        start_timeout: Real time in which the server has to answer at the start, and after a loss.
        call_timeout: Real time after which a call without a reply is given up, and its connection
            is replaced.
        on_loss: What follows when a connection is lost: the run stops, or goes on with a new one.
    """

    host: str = "127.0.0.1"
    port: Annotated[int, msgspec.Meta(ge=1, le=65535)] = 41451
    vehicle: str = ""
    flavour: Literal["auto", "airsim", "cosys"] = "auto"
    cameras: tuple[RemoteCamera, ...] = ()
    image_rate: Rate = 20
    imu_rate: Rate = 100
    control_rate: Rate = 50
    takeover: bool = True
    setpoint_timeout: Duration = Duration(0.5)  # immutable
    start_timeout: Duration = Duration(30.0)
    call_timeout: Duration = Duration(10.0)
    on_loss: Literal["stop", "reconnect"] = "stop"
