"""Make the documentation's images of worlds, sensors and renderers: worlds.jpg and so on.

The worlds are seen from a place each; the sensors are those of one flight, `tools/sensors.toml`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from events import DepthImage, Event, Image, Imu, LidarScan, SegmentationImage
from events.frames import from_rpy
from runtime.config.reading import load
from runtime.testing import run_nodes
from sims.cameras import CameraRenderer, CameraSpec, add_free_camera, model_to_bytes, pose_to_qpos
from sims.cameras.renderer import Shot
from sims.cameras.stage import RendererName
from sims.worlds import WORLDS, load_scene

DOCS = Path("docs/images")
SIZE = (384, 288)
VIEWS = {  # north, east, down, metres; roll, pitch, yaw, degrees
    "hall": (-6.4, -1.6, -2.0, 0, 0, 20),
    "yard": (-1.5, 0.5, -1.7, 0, 2, 5),
    "corridor": (-8.0, 0.0, -1.5, 0, 0, 0),
    "office": (-6.6, -3.4, -1.7, 0, -4, 25),
    "night": (4.0, 2.0, -1.7, 0, 2, 40),
    "forest": (-6.0, 6.4, -1.6, 0, 0, -60),
    "field": (-14.0, -1.5, -3.5, 0, -8, 15),
    "mocap": (-2.3, -1.6, -1.9, 0, -12, 38),
}


def main() -> None:
    """Make all images."""
    _write("worlds.jpg", {name: _seen(name) for name in WORLDS}, 4)
    _write("sensors.jpg", _sensed(), 5)
    _write("renderers.jpg", _compared(("yard", "office", "forest")), 3)


def _compared(names: tuple[str, ...]) -> dict[str, Any]:
    images = {}
    for name in names:
        ours, other = _seen(name), _seen(name, "mujoco")
        images[f"{name}: raster"], images[f"{name}: mujoco"] = ours, other
        apart = np.abs(ours.astype(int) - other)
        caption = f"8 x the difference, {apart.mean():.1f} levels on average"
        images[caption] = np.minimum(8 * apart, 255).astype(np.uint8)
    return images


def _seen(name: str, renderer: RendererName = "raster") -> Any:
    world, dynamics = load_scene(name, 1)
    camera = CameraSpec(name="camera", images=("rgb",), width=SIZE[0], height=SIZE[1])
    prefix = add_free_camera(world, "free", (camera,))
    packed = model_to_bytes(world.compile())
    stage = CameraRenderer(packed, (camera,), prefix, 0, 2, dynamics, renderer=renderer)
    north, east, down, *angles = VIEWS[name]
    roll, pitch, yaw = np.radians(angles).tolist()
    state = pose_to_qpos((north, east, down), from_rpy(roll, pitch, yaw))
    (frame,) = stage.expose((Shot("camera", 3_000_000_000, state),))
    image = frame.rgb
    stage.close()
    assert image is not None
    return image[..., ::-1]


def _sensed() -> dict[str, Any]:
    result = run_nodes(load(Path("tools/sensors.toml")).nodes, duration=7.5, seed=1)

    def last(kind: type[Event], source: str) -> Any:
        return next(e for e in reversed(result.of(kind)) if e.source == f"drone/{source}")

    def colour(source: str) -> Any:
        return last(Image, source).data[..., ::-1]

    return {
        "pinhole": colour("pinhole"),
        "plumb_bob (radtan)": colour("radtan"),
        "equidistant (fisheye), 190 degrees": colour("fisheye"),
        "rolling shutter, turning": colour("rolling"),
        "little light, auto-exposure": colour("dark"),
        "depth, ideal": _coloured(last(DepthImage, "pinhole").data),
        "depth, structured light": _coloured(last(DepthImage, "structured").data),
        "segmentation": _numbered(last(SegmentationImage, "masks").data),
        "lidar, from above": _from_above(last(LidarScan, "lidar")),
        "IMU with vibration: acceleration": _plotted(
            [event.linear_acceleration for event in result.of(Imu)]
        ),
    }


def _coloured(depth: Any) -> Any:
    """Return depth from 0 to 8 m as colours; black is no measurement."""
    known = np.isfinite(depth)
    steps = np.where(known, np.clip(255.0 - depth * 32.0, 0.0, 255.0), 0.0).astype(np.uint8)
    return np.where(known[..., None], cv2.applyColorMap(steps, cv2.COLORMAP_TURBO), 0)


def _numbered(numbers: Any) -> Any:
    table = np.random.default_rng(3).integers(40, 255, (int(numbers.max()) + 2, 3), np.uint8)
    table[0] = 0
    return table[numbers + 1]


def _from_above(scan: LidarScan) -> Any:
    """Return a turn's points from above, 20 by 15 m, ahead up, coloured by height."""
    sheet = np.full((SIZE[1], SIZE[0], 3), 24, np.uint8)
    scale = SIZE[1] / 15.0
    columns = (SIZE[0] / 2 + scan.points[:, 1] * scale).astype(int)
    rows = (SIZE[1] / 2 - scan.points[:, 0] * scale).astype(int)
    inside = (columns >= 0) & (columns < SIZE[0]) & (rows >= 0) & (rows < SIZE[1])
    levels = np.clip((1.6 - scan.points[:, 2]) * 60.0, 0, 255).astype(np.uint8)
    colours = cv2.applyColorMap(levels[:, None], cv2.COLORMAP_TURBO)[:, 0]
    sheet[rows[inside], columns[inside]] = colours[inside]
    cv2.circle(sheet, (SIZE[0] // 2, SIZE[1] // 2), 3, (255, 255, 255), -1)
    return sheet


def _plotted(values: list[Any]) -> Any:
    sheet = np.full((SIZE[1], SIZE[0], 3), 255, np.uint8)
    rows = np.array(values)[:: max(1, len(values) // SIZE[0])]
    across = np.linspace(4, SIZE[0] - 4, len(rows))
    for axis, colour in enumerate(((60, 60, 200), (60, 150, 60), (200, 90, 40))):
        about = SIZE[1] * (axis + 1) / 3.6
        down = about - 5.0 * (rows[:, axis] - np.median(rows[:, axis]))
        cv2.polylines(sheet, [np.stack([across, down], 1).astype(np.int32)], False, colour, 1,
                      cv2.LINE_AA)  # fmt: skip
    return sheet


def _write(name: str, images: dict[str, Any], columns: int) -> None:
    tiles = []
    for caption, image in images.items():
        tile = np.ascontiguousarray(image)
        cv2.rectangle(tile, (0, 0), (12 + 9 * len(caption), 22), (30, 30, 30), -1)
        cv2.putText(tile, caption, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1,
                    cv2.LINE_AA)  # fmt: skip
        tiles.append(tile)
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % columns)
    rows = [np.concatenate(tiles[k : k + columns], 1) for k in range(0, len(tiles), columns)]
    jpeg = cv2.imencode(".jpg", np.concatenate(rows), [cv2.IMWRITE_JPEG_QUALITY, 82])[1]
    (DOCS / name).write_bytes(jpeg.tobytes())


if __name__ == "__main__":
    main()
