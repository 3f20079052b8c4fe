"""A mesh file as a world: drawn by the model's meshes, solid by boxes or hulls."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from sims.scans.images import Image, decode
from sims.scans.kept import kept
from sims.scans.mesh_file import Material, MeshError, MeshFile
from sims.scans.preparing import Part, Prepared, prepare
from sims.scans.reading import read
from sims.scans.settings import SUFFIXES, USUAL, MeshSpec
from sims.scans.solids import GROUP, add_solids

DRAWN_GROUP = 2
FLAT, THICKNESS = 1e-3, 0.02  # metres: a part is flat; a flat hull is as thick
USER = "double_sided alpha_cutoff"  # names of the geoms' user numbers
_LOG = logging.getLogger("visnav.world")


def prepared_mesh(path: Path, mesh: MeshSpec = USUAL) -> Prepared:
    """Return what a world needs of a mesh file, perhaps from an earlier run.

    Raises:
        MeshError: The file cannot be read, or is no use as a world.
    """
    path = path.expanduser()
    if not path.is_file():
        what = "a directory" if path.is_dir() else "nothing"
        raise MeshError(f"{path}: expected a mesh file, found {what}")
    other = Path(mesh.solid) if mesh.solid not in ("voxels", "hulls", "none") else None
    if other is not None and other.suffix.lower() not in SUFFIXES:
        raise MeshError(
            f'solid: expected "voxels", "hulls", "none" or a mesh file, found "{mesh.solid}"'
        )

    def make() -> tuple[Prepared, Sequence[Path]]:
        file = read(path)
        solids = read(other) if other is not None else None
        sources = [*file.sources, *(solids.sources if solids else ())]
        if mesh.image:
            sources.append(Path(mesh.image))
            file = _with_image(file, _image(Path(mesh.image)))
        return prepare(file, mesh, solids), sources

    return kept(path, mesh, make)


def _image(path: Path) -> Image:
    try:
        return decode(path.read_bytes(), str(path))
    except OSError as error:
        raise MeshError(f"{path}: expected an image to read, found: {error.strerror}") from None


def _with_image(file: MeshFile, image: Image) -> MeshFile:
    """Return a file of which all that has texture coordinates and no image has this one."""
    placed = {piece.material for piece in file.pieces if piece.places is not None}
    materials = tuple(
        m._replace(image=image) if number in placed and m.image is None else m
        for number, m in enumerate(file.materials)
    )
    if not any(file.materials[number].image is None for number in placed):
        raise MeshError("image: expected texture coordinates without an image, found none")
    return file._replace(materials=materials)


def mesh_world(
    path: Path,
    mesh: MeshSpec = USUAL,
    *,
    bare: bool = False,
    aside: dict[str, Image] | None = None,
) -> Any:
    """Return a mesh file's world, as a `mujoco.MjSpec`; what is not drawn is logged.

    Args:
        bare: Leave out all that is only seen.
        aside: Takes the images, by the names of their textures, which have one texel then.

    Raises:
        MeshError: As `prepared_mesh`.
    """
    prepared = prepared_mesh(path, mesh)
    for note in prepared.notes:
        _LOG.warning("%s: %s", path.name, note)
    return build(prepared, path.stem, mesh.solid, bare=bare, aside=aside)


def build(
    prepared: Prepared,
    name: str,
    solid: str = "voxels",
    *,
    bare: bool = False,
    aside: dict[str, Image] | None = None,
) -> Any:
    """Return the world of a prepared mesh, of a setting `solid`; else as `mesh_world`."""
    spec = mujoco.MjSpec()
    spec.modelname = name
    spec.visual.quality.shadowsize = 0
    spec.visual.quality.offsamples = 0
    spec.nuser_geom = len(USER.split())
    spec.add_text(name="geom_user", data=USER)
    _add_light(spec, prepared)
    by_hulls = solid == "hulls" and not prepared.hulls
    if not bare or by_hulls:
        _add_looks(spec, prepared, bare, by_hulls, aside)
    add_solids(spec, prepared.boxes, prepared.floor)
    for part in prepared.hulls:
        _add_mesh(spec, _padded(part, solid=True), f"solid.{part.name}")
        spec.worldbody.add_geom(
            name=f"solid.{part.name}", type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=f"solid.{part.name}", group=GROUP,
        )  # fmt: skip
    return spec


def _add_light(spec: Any, prepared: Prepared) -> None:
    head = spec.visual.headlight
    head.ambient = [0.0 if prepared.baked else 0.45] * 3
    head.diffuse = head.specular = [0.0] * 3
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, rgb1=[0.75, 0.83, 0.92],
        rgb2=[0.45, 0.47, 0.5], width=64, height=384,
    )  # fmt: skip
    if not prepared.baked:
        spec.worldbody.add_light(
            name="sun", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, pos=[0.0, 0.0, 50.0],
            dir=[0.3, 0.2, -1.0], diffuse=[0.5] * 3, specular=[0.0] * 3, ambient=[0.0] * 3,
            castshadow=False,
        )  # fmt: skip


def _add_looks(
    spec: Any, prepared: Prepared, bare: bool, solid: bool, aside: dict[str, Image] | None
) -> None:
    """Add the drawn parts with their materials."""
    materials: set[int] = set()
    images: dict[int, str] = {}  # names of textures by image
    for part in (_padded(part, solid) for part in prepared.parts):
        material = prepared.materials[part.material]
        if part.material not in materials and not bare:
            materials.add(part.material)
            _add_material(spec, part.material, material, prepared.baked, images, aside)
        _add_mesh(spec, part, part.name)
        if part.colours is not None and not bare:
            _add_colours(spec, part)
        meets = int(solid)
        spec.worldbody.add_geom(
            name=part.name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=part.name,
            material="" if bare else f"m{part.material}", contype=meets, conaffinity=meets,
            group=DRAWN_GROUP, userdata=[float(material.double_sided), material.cutoff],
        )  # fmt: skip


def _add_material(
    spec: Any,
    number: int,
    material: Material,
    baked: bool,
    images: dict[int, str],
    aside: dict[str, Image] | None,
) -> None:
    *rgb, alpha = material.colour
    added = spec.add_material(
        name=f"m{number}", rgba=[*rgb, alpha if material.blend else 1.0], specular=0.0,
        shininess=0.0, reflectance=0.0, emission=float(baked),
    )  # fmt: skip
    if material.image is not None:
        if id(material.image) not in images:
            images[id(material.image)] = f"m{number}"
            image = material.image
            if aside is not None:
                aside[f"m{number}"] = image
                image = np.zeros((1, 1, image.shape[2]), np.uint8)
            _add_image(spec, f"m{number}", image)
        textures = list(added.textures)
        textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = images[id(material.image)]
        added.textures = textures


def _add_image(spec: Any, name: str, image: Any) -> None:
    height, width, channels = image.shape
    texture = spec.add_texture(
        name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=width, height=height,
        nchannel=channels,
    )  # fmt: skip
    texture.data = image.tobytes()


def _add_colours(spec: Any, part: Part) -> None:
    """Add vertices' colours as a texture, a texel each."""
    colours = part.colours
    assert colours is not None
    channels = 3 if colours[:, 3].min() == 255 else 4
    width = min(len(colours), 1024)
    rows = -(-len(colours) // width)
    texels = np.zeros((rows * width, channels), np.uint8)
    texels[: len(colours)] = colours[:, :channels]
    _add_image(spec, f"{part.name}.colours", texels.reshape(rows, width, channels))


def _add_mesh(spec: Any, part: Part, name: str) -> None:
    textured = {} if part.places is None else {"usertexcoord": part.places.ravel()}
    spec.add_mesh(
        name=name, uservert=part.points.ravel(), usernormal=part.normals.ravel(),
        userface=part.corners.ravel(), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        **textured,
    )  # fmt: skip


def _padded(part: Part, solid: bool) -> Part:
    """Return a part with further vertices, which are not drawn, where MuJoCo needs them.

    It takes no fewer than four, and makes no hull of points in a plane.
    """
    more = _behind(part) if solid else None
    if more is None:
        more = part.points[:1].repeat(max(4 - len(part.points), 0), axis=0)
    longer: dict[str, Any] = {
        field: np.concatenate([values, values[:1].repeat(len(more), axis=0)])
        for field in ("normals", "places", "colours")
        if (values := getattr(part, field)) is not None
    }
    return part._replace(points=np.concatenate([part.points, more]), **longer)


def _behind(part: Part) -> npt.NDArray[np.float32] | None:
    """Return the points of a flat part moved by `THICKNESS` away from its front; else None."""
    points = part.points.astype(np.float64)
    a, b, c = points[part.corners].transpose(1, 0, 2)
    areas = np.cross(b - a, c - a)
    x, y, z = areas[np.argmax((areas * areas).sum(axis=1))].tolist()
    length = math.sqrt(x * x + y * y + z * z)
    away = (points - points[part.corners[0, 0]]) * (x / length, y / length, z / length)
    if abs(away.sum(axis=1)).max() > FLAT:
        return None
    front = np.array((x, y, z)) / length
    return (points - THICKNESS * front).astype(np.float32)
