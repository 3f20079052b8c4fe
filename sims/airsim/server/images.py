"""Methods that take images: all of one call show one state, at one time, from its true poses."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from runtime import Worker
from sims.airsim.server.image_types import Form, ImageType
from sims.airsim.server.methods import Caller, Flavour, RpcError, rpc
from sims.airsim.server.rendering import Renderer, Wanted
from sims.airsim.structures import CosysImageResponse, ImageRequest, ImageResponse
from sims.cameras import GraphicsError

if TYPE_CHECKING:
    from sims.airsim.server.node import AirsimServer

MOST = 64
"""Images of one call, and calls that wait for their images at a time."""

ABANDONED = 8
"""Calls of clients that have left which may still be with the renderer; it is full with more."""

TIMEOUT = 600.0
"""Real seconds after which the renderer is taken to hang; the longest call takes some 30."""

LONGEST = 100_000_000
"""Bytes of all images of one call: Cosys-AirSim's client takes no more."""


_RESPONSES = {"airsim": ImageResponse, "cosys": CosysImageResponse}


class _Exposure(NamedTuple):
    """The images of one call before they are drawn: the state that they show, and what is known."""

    stamp: int
    qpos: npt.NDArray[np.float64]
    ids: npt.NDArray[np.uint8]
    wanted: list[Wanted]
    known: list[ImageResponse]


class Images:
    """Takes images of what clients ask for."""

    def __init__(self, server: AirsimServer) -> None:
        self._server = server
        self._renderer: Worker[Renderer] | None = None
        self._starting = asyncio.Lock()
        self._idle = asyncio.Semaphore(server.config.camera_processes)
        self._waiting = 0
        self._told = False

    async def start(self) -> None:
        """Start what renders, unless that is done."""
        async with self._starting:
            if self._renderer is None:
                server = self._server
                self._renderer = await server.worker(
                    Renderer,
                    await server.offload(lambda: server.world.model_bytes),
                    f"{server.name}/camera",
                    server.cameras.largest,
                    server.config.render_threads,
                    server.world.dynamics,
                    processes=server.config.camera_processes,
                    timeout=TIMEOUT,
                )

    @rpc("simGetImages", cosys=2)
    def get_images(
        self,
        caller: Caller,
        requests: list[ImageRequest],
        vehicle: str,
        external: bool = False,
    ) -> Awaitable[list[ImageResponse]]:
        """Return images of one instant, with one stamp, and the camera's true pose of then."""
        return self.take(requests, vehicle, caller.flavour, external=external)

    @rpc("simGetImage")
    def get_image(
        self, caller: Caller, camera: str, image_type: int, vehicle: str, external: bool | str = ""
    ) -> Awaitable[bytes]:
        """Return an image as PNG; it is empty if images of that type are not drawn."""
        caller.flavour = "airsim" if isinstance(external, bool) else "cosys"
        self._server.cameras.find(self._server.find_vehicle(vehicle), camera, external)
        requests = [ImageRequest(camera, image_type)]
        if image_type not in ImageType.__members__.values():
            if not self._told:
                self._server.log.warning("simGetImage: %s", _not_drawn(image_type))
            self._told, requests = True, []
        exposure = self._expose(requests, vehicle, caller.flavour)

        async def png() -> bytes:
            return b"".join([each.image_data_uint8 for each in await self._develop(exposure)])

        return png()

    def take(
        self,
        requests: Sequence[ImageRequest],
        vehicle: str,
        flavour: Flavour = "airsim",
        *,
        external: bool = False,
    ) -> Awaitable[list[ImageResponse]]:
        """Take images of the present state, and return an awaitable of them.

        The state is that of the call. Simulated time does not wait for the images.

        Args:
            requests: What is wanted.
            vehicle: Name of the vehicle that carries the cameras; empty for the first.
            flavour: Whose structures, and order of colours, are wanted.
            external: Whether cameras that no vehicle carries are meant: there are none.

        Raises:
            RpcError: There is no such vehicle, camera or type, or it is too much.
        """
        return self._develop(self._expose(requests, vehicle, flavour, external))

    def _expose(
        self,
        requests: Sequence[ImageRequest],
        vehicle: str,
        flavour: Flavour,
        external: bool = False,
    ) -> _Exposure:
        if len(requests) > MOST:
            raise RpcError(f"expected at most {MOST} images of one call, found {len(requests)}")
        on = self._server.find_vehicle(vehicle)
        stamp, qpos = self._server.drawn_state()
        exposure = _Exposure(stamp, qpos, self._server.segmentation.ids(), [], [])
        length = 0
        for each in requests:
            camera = self._server.cameras.find(on, each.camera_name, external)
            if each.image_type not in ImageType.__members__.values():
                raise RpcError(_not_drawn(each.image_type))
            eye = camera.eye(each.image_type)
            form: Form = "png" if each.compress else "rgb" if flavour == "cosys" else "bgr"
            form = "float" if each.pixels_as_float else form
            exposure.wanted.append(Wanted(eye, ImageType(each.image_type), form))
            pose = self._server.cameras.pose(on, eye, qpos)
            width, height = eye.spec.width, eye.spec.height
            length += width * height * (5 if form == "float" else 3)
            known = msgspec.structs.asdict(each) | {
                "camera_position": pose.position,
                "camera_orientation": pose.orientation,
                "time_stamp": stamp,
                "width": width,
                "height": height,
            }
            if flavour == "airsim":
                del known["annotation_name"]
            exposure.known.append(_RESPONSES[flavour](**known))
        if length > LONGEST:
            raise RpcError(f"expected images of at most {LONGEST} bytes, found {length}")
        return exposure

    async def _develop(self, exposure: _Exposure) -> list[ImageResponse]:
        abandoned = 0 if self._renderer is None else self._renderer.outstanding()
        if self._waiting >= MOST or abandoned > ABANDONED + self._server.config.camera_processes:
            raise RpcError(f"expected at most {MOST} calls that wait for images")
        self._waiting += 1
        try:
            await self.start()
            assert self._renderer is not None
            async with self._idle:
                images = await self._renderer.call_untimed(Renderer.take, *exposure[:4])
        except GraphicsError as error:
            raise RpcError(str(error)) from None
        finally:
            self._waiting -= 1
        return [
            msgspec.structs.replace(each, image_data_float=msgspec.Raw(image.data))
            if each.pixels_as_float
            else msgspec.structs.replace(each, image_data_uint8=image.tobytes())
            for each, image in zip(exposure.known, images, strict=True)
        ]


def _not_drawn(image_type: int) -> str:
    return (
        f"not supported by visnav-runtime: images of type {image_type}: expected one of "
        + ", ".join(f"{each.value} ({each.name.lower()})" for each in ImageType)
    )
