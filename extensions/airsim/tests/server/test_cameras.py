"""The cameras that clients know, and the images that they get, decoded and compared by value."""

from __future__ import annotations

import json
import math
import re
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from extensions.airsim.tests.scripts import Caller, RefusedError, drone, with_script
from runtime.testing import spec
from sims.cameras.spec import CameraSpec, Stereo
from sims.computer_vision import FreeCamera
from visnav_airsim.server.cameras import LONGEST, MOST, Capture, ServedCamera, cameras_by_name
from visnav_airsim.server.objects import initial_id
from visnav_airsim.server.rendering import ImageType, palette
from visnav_airsim.settings import default_mount

FIELD_OF_VIEW = "simGetCurrentFieldOfView"
NAMES = "front_center", "0", "", "fpv", "front_right", "1", "2", "bottom_center", "3", "4"


def vector(fields: dict[str, float]) -> tuple[float, float, float]:
    return fields["x_val"], fields["y_val"], fields["z_val"]


def info(call: Caller, name: str, vehicle: str = "") -> Any:
    return call("simGetCameraInfo", name, vehicle, False)


def test_a_vehicle_has_airsims_default_cameras(tiny_world: str) -> None:
    infos = {}

    def script(call: Caller) -> None:
        infos.update({name: info(call, name) for name in NAMES})

    with_script(script, [drone(world=tiny_world, yaw=90.0)])
    for name in NAMES:
        (x, y, z), (_, pitch, yaw) = default_mount(name, False)
        assert vector(infos[name]["pose"]["position"]) == pytest.approx((-y, x, z), abs=1e-6)
        quaternion = infos[name]["pose"]["orientation"]
        half = math.radians(90.0 + yaw) / 2.0
        expected = math.cos(half) * math.cos(math.radians(pitch) / 2.0)
        assert abs(quaternion["w_val"]) == pytest.approx(abs(expected), abs=1e-6)
    assert infos["0"] == infos[""] == infos["fpv"] == infos["front_center"] != infos["1"]
    assert infos["0"]["fov"] == 90.0
    assert infos["0"]["proj_mat"]["matrix"] == [
        pytest.approx(row)
        for row in ([0, 1, 0, 0], [0, 0, -256 / 144, 0], [0, 0, 0, 10], [-1, 0, 0, 0])
    ]


def test_cameras_of_the_settings_and_of_the_file_go_before_default_ones() -> None:
    entries = [
        ServedCamera(name="front_center", captures=(Capture(image_type=5, fov=60.0),)),
        ServedCamera(name="fpv", orientation=(0.0, -90.0, 0.0)),
        ServedCamera(name="bottom_center", captures=(Capture(fov=30.0, width=100, height=200),)),
        ServedCamera(name="both", position=(1.0, 2.0, 3.0)),
    ]
    own = [
        CameraSpec(name="front_right", width=40, height=20, fov=120.0),
        CameraSpec(name="pair", stereo=Stereo(baseline=0.3)),
        CameraSpec(name="both"),
    ]
    cameras = cameras_by_name(own, entries, 3, free=False)
    assert cameras["0"] is cameras[""] is cameras["front_center"] is not cameras["fpv"]
    assert cameras["0"].eye(5).spec.fov == 60.0
    assert cameras["0"].eye(0).spec.fov == 90.0
    assert cameras["0"].mount == ((0.46, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    assert cameras["fpv"].mount[1] == pytest.approx((0.5**0.5, 0.0, -(0.5**0.5), 0.0))
    assert cameras["3"] is cameras["bottom_center"]
    assert cameras["3"].mount[0] == (0.0, 0.0, 0.12)
    assert cameras["3"].eye(0).spec.height == 200
    assert cameras["3"].eye(1).spec.height == 144
    assert cameras["1"] is cameras["front_right"]
    assert {cameras["1"].eye(kind).spec.width for kind in ImageType} == {40}
    assert cameras["pair_right"].mount[0] == pytest.approx((0.15, 0.3, 0.0))
    assert cameras["both"].mount[0] == (1.0, 2.0, 3.0)
    assert "pair" not in cameras
    assert cameras["4"].eye(0).body == 3


@given(st.sets(st.sampled_from(NAMES)), st.sets(st.sampled_from(NAMES)))
def test_default_names_are_always_there_and_given_ones_are_those_given(
    entries: set[str], own: set[str]
) -> None:
    cameras = cameras_by_name(
        [CameraSpec(name=name) for name in sorted(own)],
        [ServedCamera(name=name) for name in sorted(entries)],
        1,
        free=False,
    )
    assert cameras.keys() >= {*NAMES, "front_left", "back_center"}
    assert len({id(cameras[name]) for name in own | entries}) == len(own | entries)
    unnamed = len({default_mount(name, False) for name in set(cameras) - own - entries})
    assert len({id(camera) for camera in cameras.values()}) <= len(own | entries) + unnamed


@pytest.mark.slow
def test_clients_are_told_the_announced_calibration(tiny_world: str) -> None:
    replies: dict[str, Any] = {}

    def script(call: Caller) -> None:
        replies["front"] = info(call, "front")
        request = [{"camera_name": "front", "image_type": 0, "compress": False}]
        (replies["image"],) = call("simGetImages", request, "", False)
        settings = json.loads(call("getSettingsString"))
        replies["settings"] = settings["Vehicles"]["drone"]["Cameras"]["front"]
        call("simSetCameraPose", "front", {"position": {"x_val": 1.0}}, "", False)
        replies["moved"] = info(call, "front")

    error = {"position": [0.0, 0.2, 0.0], "rotation": [0.0, 10.0, 0.0], "focal": [8.0, 8.0]}
    camera = {"name": "front", "width": 64, "height": 48, "images": ["grey"]}
    camera |= {"intrinsics": [32.0, 32.0, 31.5, 23.5], "calibration_error": error}
    with_script(script, [drone(world=tiny_world, cameras=[camera], camera_processes=1)])
    fov = 2.0 * math.degrees(math.atan(32.0 / 40.0))
    place = vector(replies["front"]["pose"]["position"])
    assert place == pytest.approx((0.15, 0.2, 0.0), abs=2e-3)
    assert replies["front"]["fov"] == pytest.approx(fov)
    half = math.radians(10.0) / 2.0  # about the optical y axis: down
    assert replies["front"]["pose"]["orientation"]["z_val"] == pytest.approx(math.sin(half))
    assert vector(replies["image"]["camera_position"]) == pytest.approx(place)
    assert replies["settings"]["Y"] == pytest.approx(0.2)
    assert replies["settings"]["Yaw"] == pytest.approx(10.0)
    assert replies["settings"]["CaptureSettings"][0]["FOV_Degrees"] == pytest.approx(fov)
    assert vector(replies["moved"]["pose"]["position"]) == pytest.approx((1.0, 0.0, 0.0), abs=2e-3)


@pytest.mark.slow
def test_in_computer_vision_mode_the_cameras_are_at_the_body(tiny_world: str) -> None:
    infos: dict[str, Any] = {}

    def script(call: Caller) -> None:
        infos.update({name: info(call, name) for name in ("0", "1", "3", "any")})

    settings = {"world": tiny_world, "camera_processes": 1, "position": [1, 2, -3]}
    with_script(script, [spec(FreeCamera, "free", settings | {"cameras": [{"name": "any"}]})])
    assert vector(infos["0"]["pose"]["position"]) == pytest.approx((0, 0, 0))
    assert vector(infos["1"]["pose"]["position"]) == pytest.approx((0, 0.125, 0))
    assert vector(infos["3"]["pose"]["position"]) == pytest.approx((0, 0, 0))
    assert vector(infos["any"]["pose"]["position"]) == pytest.approx((0.15, 0, 0))


def test_a_camera_that_is_not_there_fails_the_whole_call(tiny_world: str) -> None:
    def script(call: Caller) -> None:
        info(call, "own", "other")
        with pytest.raises(RefusedError, match=r"expected a camera of drone .*, found 'own'\."):
            info(call, "own", "drone")
        call.refuses(
            "'own'", "simGetImages", [{"camera_name": "0"}, {"camera_name": "own"}], "", False
        )
        call.refuses("external cameras", "simGetCameraInfo", "0", "", True)

    two = [drone(world=tiny_world), drone("other", position=[-3.0, 0.0])]
    with_script(script, two, cameras=[{"name": "own", "vehicle": "other"}])


def test_clients_move_cameras_and_change_their_view(tiny_world: str) -> None:
    pose = {
        "position": {"x_val": 0.5, "y_val": -0.25, "z_val": 1.0},
        "orientation": {"w_val": 1.0, "x_val": 0.0, "y_val": 0.0, "z_val": 1.0},
    }
    infos: dict[str, Any] = {}

    def script(call: Caller) -> None:
        call("simSetCameraPose", "fpv", pose, "", False)
        call("simSetCameraFov", "0", 60, "", False)
        infos.update({name: info(call, name) for name in ("0", "1")})
        for arguments in (("0", "", False), ("front_center", "")):  # AirSim's, Cosys-AirSim's
            words = re.findall(
                r"\t ?(\w+) Field Of View: ([\d.]+)", call(FIELD_OF_VIEW, *arguments)
            )
            assert {word: float(number) for word, number in words} == pytest.approx(
                {"Horizontal": 60.0, "Vertical": 35.98}, abs=0.01
            )
        call.refuses("expected a camera of drone", FIELD_OF_VIEW, "none", "", False)
        bad: dict[str, Any]
        for bad in (
            {"position": {"x_val": math.nan}},
            {"position": {"y_val": 1e300}},
            {"orientation": {"w_val": 0.0}},
            {"orientation": {"z_val": math.inf}},
        ):
            call.refuses(
                "expected a rotation, and numbers up to 1e",
                "simSetCameraPose",
                "0",
                pose | bad,
                "",
                False,
            )
        for degrees in (0.5, 171.0, math.nan, math.inf):
            call.refuses(
                "expected a field of view of 1 to 170 degrees",
                "simSetCameraFov",
                "0",
                degrees,
                "",
                False,
            )
        assert call("simGetDistortionParams", "0", "", False) == [0.0] * 5
        call("simSetDistortionParam", "0", "K1", 0, "", False)
        with pytest.raises(RefusedError, match=r"not supported by visnav-runtime: .*K1 = 0\.1"):
            call("simSetDistortionParam", "0", "K1", 0.1, "", False)
        assert info(call, "0") == infos["0"]

    with_script(script, [drone(world=tiny_world)])
    assert vector(infos["0"]["pose"]["position"]) == pytest.approx((0.5, -0.25, 1.0), abs=1e-5)
    assert infos["0"]["pose"]["orientation"]["z_val"] == pytest.approx(math.sqrt(0.5))
    assert infos["0"]["fov"] == 60.0
    assert infos["1"]["fov"] == 90.0


@pytest.mark.parametrize(
    ("cameras", "message"),
    [
        ([{"name": "a", "vehicle": "nobody"}], 'cameras: a: vehicle: .* found "nobody"'),
        ([{"name": "a"}, {"name": "a", "vehicle": "drone"}], r"found \['a', 'a'\]"),
    ],
)
def test_wrong_settings_are_refused(
    tiny_world: str, cameras: list[dict[str, Any]], message: str
) -> None:
    with pytest.raises(Exception, match=message):
        with_script(lambda _: None, [drone(world=tiny_world)], cameras=cameras)


@pytest.mark.parametrize(
    "wrong",
    [{"projection": "orthographic"}, {"image_type": 12}, {"fov": 171.0}, {"width": 9000}],
    ids=str,
)
def test_wrong_captures_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(msgspec.ValidationError, match=next(iter(wrong))):
        msgspec.convert(wrong, Capture)


CAMERAS = [
    {
        "name": "eye",
        "captures": [
            {"image_type": kind, "width": 32 + kind, "height": 24, "fov": 60.0} for kind in range(8)
        ],
    },
    {"name": "huge", "captures": [{"width": 4096, "height": 4096}]},
]
AHEAD = 5.0 - 1.0
"""Distance of the wall of the tiny world from its origin, metres."""


def request(name: str, kind: int, *, floats: bool = False, compress: bool = False) -> Any:
    return {
        "camera_name": name,
        "image_type": kind,
        "pixels_as_float": floats,
        "compress": compress,
    }


def images(call: Caller, *requests: Any, vehicle: str = "") -> Any:
    return call("simGetImages", list(requests), vehicle, False)


def pixels(response: Any) -> Any:
    """Return the image of a response, decoded as scripts do, shape (h, w) or (h, w, 3)."""
    size = response["height"], response["width"]
    if response["pixels_as_float"]:
        assert response["image_data_uint8"] == b""
        return np.array(response["image_data_float"], np.float32).reshape(size)
    assert response["image_data_float"] == []
    data = np.frombuffer(response["image_data_uint8"], np.uint8)
    if not response["compress"]:
        return data.reshape(*size, 3)
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert image.shape == (*size, 4)
    assert (image[..., 3] == 255).all()
    return image[..., :3]


@pytest.mark.slow
def test_each_type_shows_what_is_there(tiny_world: str) -> None:
    replies: dict[str, Any] = {}

    def script(call: Caller) -> None:
        replies["info"] = call("simGetCameraInfo", "eye", "", False)
        replies["float"] = images(call, *(request("eye", k, floats=True) for k in range(8)))
        replies["bytes"] = images(call, *(request("eye", k) for k in range(8)))
        replies["png"] = images(call, *(request("eye", k, compress=True) for k in range(8)))
        replies["one"] = call("simGetImage", "eye", 5, "", False)

    with_script(script, [drone(world=tiny_world, position=[1.0, 0.0])], cameras=CAMERAS)
    for response in replies["float"] + replies["bytes"] + replies["png"]:
        kind = response["image_type"]
        assert (response["width"], response["height"]) == (32 + kind, 24)
        assert response["time_stamp"] == 0
        assert response["camera_name"] == "eye"
        assert response["camera_position"] == replies["info"]["pose"]["position"]
        assert response["camera_orientation"] == replies["info"]["pose"]["orientation"]
        assert "annotation_name" not in response
    middle = [pixels(reply)[8, 16] for reply in replies["float"]]  # above the horizon: the wall
    assert middle[1] == pytest.approx(AHEAD - 1.0, abs=1e-4)
    assert middle[2] == pytest.approx(middle[1], rel=0.02)
    assert middle[2] > middle[1]
    assert middle[3] == pytest.approx(middle[1] / 100.0)
    assert middle[4] == pytest.approx(0.25 / (2.0 * math.tan(math.radians(30.0)) * middle[1]))
    wall = initial_id("wall")
    colours = [pixels(reply) for reply in replies["bytes"]]
    assert (colours[1][8, 16] == 255).all()  # far beyond a metre
    assert (colours[3][8, 16] == round(2.55 * middle[1])).all()
    assert colours[5][8, 16].tolist() == palette()[wall][::-1].tolist()
    assert colours[5][-1, 16].tolist() == palette()[initial_id("floor")][::-1].tolist()
    south, up = [128, 128, 0], [0, 128, 128]  # blue first
    assert colours[6][8, 16] == pytest.approx(south, abs=1)
    assert colours[6][-1, 16] == pytest.approx(up, abs=1)
    assert colours[7][8, 16].tolist() == [wall] * 3
    for raw, png, floats in zip(colours, replies["png"], replies["float"], strict=True):
        assert np.array_equal(raw, pixels(png))
        if floats["image_type"] in {0, 5, 6, 7}:
            assert pixels(floats) == pytest.approx(raw[..., 2] / 255.0)
    assert replies["one"] == replies["png"][5]["image_data_uint8"]


@pytest.mark.slow
def test_cosys_gets_red_first_and_its_own_fields(tiny_world: str) -> None:
    replies: dict[str, Any] = {}

    def script(call: Caller) -> None:
        wanted = [request("eye", 5) | {"annotation_name": "mine"}]
        (replies["airsim"],) = call("simGetImages", wanted, "", False)
        (replies["cosys"],) = call("simGetImages", wanted, "")
        replies["one"] = call("simGetImage", "eye", 5, "", "")

    with_script(script, [drone(world=tiny_world)], cameras=CAMERAS)
    assert np.array_equal(pixels(replies["airsim"])[..., ::-1], pixels(replies["cosys"]))
    assert replies["cosys"].keys() - replies["airsim"].keys() == {"annotation_name"}
    assert replies["cosys"]["annotation_name"] == "mine"
    assert replies["one"].startswith(b"\x89PNG")


@pytest.mark.slow
def test_vehicles_see_each_other_and_fly_on_unchanged(tiny_world: str) -> None:
    replies: dict[str, Any] = {}

    def script(call: Caller, *, takes_images: bool = True) -> None:
        call("enableApiControl", True, "drone")
        takeoff = call.send("takeoff", 20.0, "drone")
        for second in range(2):
            if takes_images:
                (replies[f"seen {second}"],) = images(call, request("eye", 7))
                replies[f"pose {second}"] = call("simGetVehiclePose", "drone")
            call("simContinueForTime", 1.0)
        if takes_images:
            late = call.send("simGetImages", [request("eye", 1, floats=True)] * 2, "", False)
            call("simContinueForTime", 0.5)
            replies["late"] = call.join(late)
        else:
            call("simContinueForTime", 0.5)
        del takeoff

    two = [drone(world=tiny_world), drone("other", position=[2.0, 0.0])]
    flown = with_script(script, two, cameras=CAMERAS)
    other = initial_id("other")
    assert other in pixels(replies["seen 0"])
    for second in range(2):
        response, pose = replies[f"seen {second}"], replies[f"pose {second}"]
        assert response["time_stamp"] == second * 1_000_000_000
        assert response["camera_position"] == pose["position"] != {}
    assert replies["pose 1"]["position"]["z_val"] < -0.01
    stamps = {reply["time_stamp"] for reply in replies["late"]}
    assert stamps == {2_000_000_000}
    assert replies["late"][0] == replies["late"][1]

    without = with_script(lambda call: script(call, takes_images=False), two, cameras=CAMERAS)
    assert flown.sent == without.sent


@pytest.mark.slow
def test_a_free_camera_shows_at_once_where_it_has_been_put(tiny_world: str) -> None:
    responses: list[Any] = []

    def script(call: Caller) -> None:
        for north in (0.0, 1.5, -2.0):
            position = {"x_val": north, "y_val": 0.0, "z_val": 0.0}
            call("simSetVehiclePose", {"position": position, "orientation": {}}, True, "")
            responses.extend(images(call, request("eye", 1, floats=True)))
            assert call("simGetVehiclePose", "")["position"] == position

    settings = {"world": tiny_world, "camera_processes": 1, "cameras": [{"name": "any"}]}
    with_script(script, [spec(FreeCamera, "free", settings)], cameras=CAMERAS)
    for response, north in zip(responses, (0.0, 1.5, -2.0), strict=True):
        assert response["camera_position"]["x_val"] == pytest.approx(north)
        assert pixels(response)[10, 16] == pytest.approx(AHEAD - north, abs=1e-4)


@pytest.mark.slow
def test_segmentation_ids_are_set_and_told(tiny_world: str) -> None:
    identifiers: dict[str, Any] = {}

    def script(call: Caller) -> None:
        def seen() -> set[int]:
            (response,) = images(call, request("eye", 7))
            return set(np.unique(pixels(response)).tolist())

        assert call("simGetSegmentationObjectID", "WALL") == initial_id("wall")
        assert call("simGetSegmentationObjectID", "nothing") == -1
        before = call.send("simGetImages", [request("eye", 7)], "", False)
        assert call("simSetSegmentationObjectID", "wall", 7, False) is True
        assert initial_id("wall") in pixels(call.join(before)[0])
        assert call("simSetSegmentationObjectID", "WALL", 8, False) is False
        identifiers["plain"] = seen()
        assert call("simSetSegmentationObjectID", "W.*", 300, True) is True
        assert call("simSetSegmentationObjectID", "w", 1, True) is False
        assert call("simGetSegmentationObjectID", "wall") == 255
        identifiers["regex"] = seen()
        assert call("simSetSegmentationObjectID", "wall", -1, False) is True
        assert call("simGetSegmentationObjectID", "wall") == -1
        identifiers["hidden"] = seen()
        call.refuses("regular expression", "simSetSegmentationObjectID", "(", 1, True)

    with_script(script, [drone(world=tiny_world)], cameras=CAMERAS)
    floor = initial_id("floor")
    assert identifiers["plain"] - {0} == {floor, 7}
    assert identifiers["regex"] - {0} == {floor, 255}
    assert identifiers["hidden"] == {0, floor}


@pytest.mark.slow
def test_any_list_of_requests_is_answered_in_order(tiny_world: str) -> None:
    names = st.sampled_from(["eye", "0", "", "bottom_center", "camera"])
    requests = st.builds(
        request, names, st.integers(0, 7), floats=st.booleans(), compress=st.booleans()
    )

    def script(call: Caller) -> None:
        @settings(max_examples=12, deadline=None)
        @given(st.lists(requests, max_size=5))
        def check(wanted: list[Any]) -> None:
            responses = images(call, *wanted)
            assert len(responses) == len(wanted)
            for response, request in zip(responses, wanted, strict=True):
                assert {key: response[key] for key in request} == request
                eye = 32 + request["image_type"], 24
                usual = {"eye": eye, "camera": (20, 10)}.get(request["camera_name"], (256, 144))
                assert (response["width"], response["height"]) == usual
                pixels(response)

        check()

    camera = {"name": "camera", "width": 20, "height": 10}
    with_script(
        script, [drone(world=tiny_world, cameras=[camera], camera_processes=1)], cameras=CAMERAS
    )


@pytest.mark.slow
def test_what_cannot_be_drawn_is_refused_before_anything_is(tiny_world: str) -> None:
    def script(call: Caller) -> None:
        for kind in (-1, 8, 9, 10, 11, 12, 1 << 40):
            with pytest.raises(RefusedError, match=f"not supported .* images of type {kind}: "):
                images(call, request("eye", 0), request("eye", kind))
            assert call("simGetImage", "eye", kind, "", False) == b""
        with pytest.raises(RefusedError, match=f"at most {MOST} images of one call, found 1000"):
            images(call, *[request("eye", 0)] * 1000)
        with pytest.raises(RefusedError, match=f"at most {LONGEST} bytes, found"):
            images(call, *[request("huge", 0)] * 2)
        with pytest.raises(RefusedError, match="Vehicle Sim-API for 'nobody' is not available"):
            images(call, request("eye", 0), vehicle="nobody")
        wrong: Any
        for wrong in ([1], [{"image_type": "0"}], [{"camera_name": 5}], {}, None):
            call.refuses("simGetImages", "simGetImages", wrong, "", False)
        assert images(call) == []

    with_script(script, [drone(world=tiny_world)], cameras=CAMERAS)


@pytest.mark.slow
def test_clients_may_leave_and_the_next_one_is_served(tiny_world: str) -> None:
    def script(call: Caller) -> None:
        for _ in range(15):
            gone = Caller(call._socket.getpeername()[1])
            for _ in range(2 * MOST):
                gone.send("simGetImages", [request("large", 6, compress=True)] * 3, "", False)
            gone.send("ping")
            gone.close()
        served, refused = 0, 0
        while not served:
            waiting = [call.send("simGetImages", [request("eye", 0)], "", False) for _ in range(3)]
            for pending in waiting:
                try:
                    served += len(call.join(pending))
                except RefusedError as error:
                    refused += 1
                    assert f"at most {MOST} calls" in str(error)  # noqa: PT017  # either will do

    large = {"name": "large", "captures": [{"image_type": 6, "width": 300, "height": 300}]}
    with_script(script, [drone(world=tiny_world)], cameras=[*CAMERAS, large])


@pytest.mark.slow
def test_without_gl_all_else_is_served(tiny_world: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", "/nowhere.json")  # in the worker

    def script(call: Caller) -> None:
        for _ in range(2):
            with pytest.raises(RefusedError, match="cannot render: expected a working EGL"):
                images(call, request("eye", 0))
        assert call("ping") is True

    with_script(script, [drone(world=tiny_world)], cameras=CAMERAS, renderer="mujoco")
