"""Make the example of a scan: examples/hall.glb, the hall as many meshes, and its image."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import cv2
import mujoco
import numpy as np

from sims.cameras.meshes import mesh_of, shape_of
from sims.scans.settings import MeshSpec
from sims.survey.survey import Survey
from sims.worlds import load_world

FILE, IMAGE = Path("examples/hall.glb"), Path("docs/images/scan.jpg")
WIDTH = 1120  # of the image
SHARE, QUALITY = 0.6, 75  # of the images' size; of JPEG
UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # z up to y up


class Buffer:
    """Binary part of a GLB file, with its views and accessors."""

    def __init__(self) -> None:
        self.data = b""
        self.views: list[Any] = []
        self.accessors: list[Any] = []

    def view(self, data: bytes) -> int:
        """Add bytes, and return the number of their view."""
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)})
        self.data += data + bytes(-len(data) % 4)
        return len(self.views) - 1

    def accessor(self, values: Any, kind: str, component: int) -> int:
        """Add an array, and return the number of its accessor."""
        bounds = {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        self.accessors.append(
            {
                "bufferView": self.view(values.tobytes()), "componentType": component,
                "count": len(values), "type": kind, **(bounds if kind == "VEC3" else {}),
            }
        )  # fmt: skip
        return len(self.accessors) - 1


def main() -> None:
    """Write the file."""
    model, buffer = load_world("hall", 1).compile(), Buffer()
    gltf: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "visnav-runtime"}, "scene": 0,
        "extensionsUsed": ["KHR_materials_unlit"], "images": [], "textures": [], "materials": [],
        "meshes": [], "nodes": [], "scenes": [{"nodes": []}],
    }  # fmt: skip
    for number in range(model.nmat):
        texture = int(model.mat_texid[number, 1])
        gltf["images"].append(
            {"bufferView": buffer.view(jpeg(model, texture)), "mimeType": "image/jpeg"}
        )
        gltf["textures"].append({"source": number})
        gltf["materials"].append(
            {
                "name": model.material(number).name, "extensions": {"KHR_materials_unlit": {}},
                "pbrMetallicRoughness": {"baseColorTexture": {"index": number}},
            }
        )  # fmt: skip
    data: Any = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for geom in np.flatnonzero(model.geom_group < 3).tolist():
        mesh = mesh_of(model, *shape_of(model, geom))
        turn = data.geom_xmat[geom].reshape(3, 3)
        points = (mesh.points @ turn.T + data.geom_xpos[geom]) @ UP.T
        primitive = {
            "attributes": {
                "POSITION": buffer.accessor(points.astype(np.float32), "VEC3", 5126),
                "TEXCOORD_0": buffer.accessor(mesh.places, "VEC2", 5126),
            },
            "indices": buffer.accessor(
                mesh.corners.astype(np.uint16).reshape(-1, 1), "SCALAR", 5123
            ),
            "material": int(model.geom_matid[geom]),
        }
        name = model.geom(geom).name.removesuffix(".look")
        gltf["meshes"].append({"name": name, "primitives": [primitive]})
        gltf["nodes"].append({"name": name, "mesh": len(gltf["nodes"])})
        gltf["scenes"][0]["nodes"].append(len(gltf["nodes"]) - 1)
    gltf |= {"bufferViews": buffer.views, "accessors": buffer.accessors}
    gltf["buffers"] = [{"byteLength": len(buffer.data)}]
    head = json.dumps(gltf, separators=(",", ":")).encode()
    head += b" " * (-len(head) % 4)
    size = 12 + 8 + len(head) + 8 + len(buffer.data)
    FILE.write_bytes(
        struct.pack("<4sII", b"glTF", 2, size) + struct.pack("<I4s", len(head), b"JSON") + head
        + struct.pack("<I4s", len(buffer.data), b"BIN\0") + buffer.data
    )  # fmt: skip


def draw() -> None:
    """Draw what `python -m runtime world` draws of the file."""
    survey = Survey(FILE, MeshSpec())
    for line in survey.lines():
        print(line)
    sheet = survey.sheet()
    size = WIDTH, round(sheet.shape[0] * WIDTH / sheet.shape[1])
    small = cv2.resize(sheet, size, interpolation=cv2.INTER_AREA)
    _, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 85])
    IMAGE.write_bytes(data.tobytes())


def jpeg(model: Any, texture: int) -> bytes:
    """Return a texture of the model as JPEG."""
    width, height = int(model.tex_width[texture]), int(model.tex_height[texture])
    start = int(model.tex_adr[texture])
    image = model.tex_data[start : start + 3 * width * height].reshape(height, width, 3)
    size = round(width * SHARE), round(height * SHARE)
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)[..., ::-1]
    _, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return data.tobytes()


if __name__ == "__main__":
    main()
    draw()
