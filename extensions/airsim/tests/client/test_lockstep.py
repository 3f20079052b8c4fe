"""The client leads a server's time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from events import (
    CameraAnnouncement,
    DepthImage,
    Event,
    Image,
    Imu,
    ImuAnnouncement,
    Odometry,
    PoseStamped,
    SegmentationImage,
    VehicleAnnouncement,
)
from events.frames import OPTICAL_TO_FRD
from extensions.airsim.tests.client.fake import START, FakeServer, HangUp, NoReply
from runtime.errors import FatalError, VisnavError
from runtime.testing import NodeResult, run_node, run_nodes, spec
from visnav_airsim.client import AirsimClient
from visnav_airsim.wire import ImuData, MultirotorState, Vector3r

NAN = float("nan")


def settings(server: FakeServer, **config: Any) -> dict[str, Any]:
    return {"port": server.port, "start_timeout": 2.0, "call_timeout": 0.3} | config


def fly(server: FakeServer, seconds: float = 0.1, inputs: Any = (), **config: Any) -> NodeResult:
    """Run the client for a while, and 1 ns, so that what is due at its end is done."""
    config = settings(server, **config)
    return run_node(
        AirsimClient, config=config, duration=seconds + 1e-9, inputs=inputs, name="drone"
    )


@pytest.fixture
def server() -> Any:
    with FakeServer().serving() as server:
        yield server


@pytest.mark.slow
def test_images_depth_pose_imu_and_truth_are_of_one_instant(server: FakeServer) -> None:
    server.velocity = Vector3r(1.0, 2.0, 3.0)
    result = fly(server, image_rate=20, imu_rate=100)
    frequent: tuple[type[Event], ...] = (Imu, Odometry)
    for kind in frequent:
        assert [e.stamp for e in result.of(kind)] == [n * 10_000_000 for n in range(11)]
    rare: tuple[type[Event], ...] = (Image, DepthImage, PoseStamped)
    for kind in rare:
        assert [e.stamp for e in result.of(kind)] == [0, 50_000_000, 100_000_000]
    image, depth, pose = result.of(Image)[0], result.of(DepthImage)[0], result.of(PoseStamped)[0]
    assert {image.source, depth.source, pose.source} == {"drone/0"}
    assert image.data.shape == (4, 8, 3)
    assert image.data[0, 0].tolist() == [200, 0, 1]  # the server's order is blue, green, red
    assert depth.data[0].tolist() == [1, 2, 3, 4, 5, 6, 7, 8]
    assert depth.data[-1, -1] == np.inf
    # The pawn is 10 m north in the world, and 1 m east of its start.
    assert pose.position == (10.5, 1.0, -0.25)
    assert pose.orientation == OPTICAL_TO_FRD
    truth = result.of(Odometry)[0]
    assert truth.position == (10.0, 1.0, 0.0)
    assert truth.linear_velocity == (1.0, 2.0, 3.0)
    assert [call[0] for call in server.made("simContinueForTime")] == [0.01] * 10


@pytest.mark.slow
def test_what_a_simulator_announces_is_announced(server: FakeServer) -> None:
    result = fly(server, imu_rate=200, image_rate=10)
    (camera,) = result.of(CameraAnnouncement)
    assert camera.images == ("rgb", "depth")
    assert (camera.info.width, camera.info.height) == (8, 4)
    assert camera.info.fx == pytest.approx(4.0 / np.tan(np.radians(30.0)))
    assert (camera.info.cx, camera.info.cy) == (3.5, 1.5)
    assert camera.position == (0.5, 0.0, -0.25)  # less where the vehicle is
    assert camera.orientation == OPTICAL_TO_FRD
    (vehicle,) = result.of(VehicleAnnouncement)
    assert vehicle.position == (10.0, 1.0, 0.0)
    (imu,) = result.of(ImuAnnouncement)
    assert imu.rate == 200


@pytest.mark.slow
def test_cameras_and_noise_are_those_of_the_servers_settings(server: FakeServer) -> None:
    text = """{"SettingsVersion": 1.2, "SimMode": "Multirotor", "Vehicles": {"Alpha": {
        "VehicleType": "SimpleFlight", "X": 3, "Y": -4, "Z": 0,
        "Cameras": {"eye": {"CaptureSettings": [
            {"ImageType": 0, "Width": 8, "Height": 4, "FOV_Degrees": 120},
            {"ImageType": 7, "Width": 8, "Height": 4, "FOV_Degrees": 120}]}},
        "Sensors": {"i": {"SensorType": 2, "Enabled": true, "AngularRandomWalk": 0.6}}}}}"""
    server.methods["getSettingsString"] = lambda: text
    del server.methods["simGetObjectPose"]
    result = fly(server)
    (camera,) = result.of(CameraAnnouncement)
    assert camera.source == "drone/eye"
    assert camera.images == ("rgb", "segmentation")
    assert camera.info.fx == pytest.approx(4.0 / np.tan(np.radians(60.0)))
    (imu,) = result.of(ImuAnnouncement)
    assert imu.gyroscope_noise_density == pytest.approx(2 * 8.7266e-5, rel=1e-4)
    assert imu.accelerometer_random_walk == pytest.approx(1.2482e-5, rel=1e-4)
    assert result.of(VehicleAnnouncement)[0].position == (3.0, -3.0, 0.0)
    assert result.of(SegmentationImage)[0].data.tolist() == [[8] * 8] * 4


@pytest.mark.slow
def test_cosys_takes_other_arguments_and_sends_other_colours(server: FakeServer) -> None:
    server.methods["getServerVersion"] = lambda: 4
    result = fly(server)
    assert result.of(Image)[0].data[0, 0].tolist() == [1, 0, 200]
    assert {len(call) for call in server.made("simGetImages")} == {2}
    assert server.made("simGetCameraInfo") == [["0", "Alpha"]]
    assert server.made("simGetObjectPose") == [["Alpha", True]]


@pytest.mark.slow
def test_depth_of_another_size_is_resampled(server: FakeServer) -> None:
    whole = server.images

    def images(requests: Any, *rest: Any) -> Any:
        responses = []
        for request in requests:
            server.size = (4, 2) if request["image_type"] == 1 else (8, 4)
            responses += whole([request], *rest)
        return responses

    server.methods["simGetImages"] = images
    depth = fly(server).of(DepthImage)[0].data
    assert (
        depth.tolist() == [[1, 1, 2, 2, 3, 3, 4, 4]] * 2 + [[5, 5, 6, 6, 7, 7, np.inf, np.inf]] * 2
    )


@pytest.mark.slow
def test_a_server_that_steps_inexactly_is_followed_and_no_digest_promised(
    server: FakeServer,
) -> None:
    def go_on(seconds: float) -> None:
        server.time += round(seconds * 1e9) + 3_000_000

    server.methods["simContinueForTime"] = go_on
    result = fly(server, 0.1, imu_rate=100)
    assert [e.stamp for e in result.of(Odometry)] == [n * 13_000_000 for n in range(8)]


@pytest.mark.slow
def test_a_repeated_sample_is_dropped_and_a_gap_survived(server: FakeServer) -> None:
    server.methods["getImuData"] = lambda *_: ImuData(server.time // 30_000_000 * 30_000_000)
    stamps = [e.stamp for e in fly(server, 0.1, imu_rate=100).of(Imu)]
    assert len(stamps) == len(set(stamps)) < 6


@pytest.mark.slow
def test_bad_answers_are_survived(server: FakeServer) -> None:
    colours: dict[str, Any] = {"width": 1, "height": 1, "image_data_uint8": b"123"}
    depth: dict[str, Any] = {"width": 1, "height": 1, "image_data_float": [1.0]}
    nowhere = {"x_val": NAN}
    bad: dict[str, list[Any]] = {
        "getImuData": [
            ImuData(START + 10**8, linear_acceleration=Vector3r(NAN, 0, 0)),
            {"time_stamp": "soon"},
            None,
        ],
        "simGetImages": [
            [],
            [{"width": 9, "height": 9}] * 2,
            [colours, {}],
            [colours | {"time_stamp": START + 10**8}, depth],  # well, but of another size
            [colours | {"time_stamp": START + 10**9, "camera_position": nowhere}, depth],
        ],
        "simGetCollisionInfo": [{"has_collided": True, "time_stamp": START * 2, "normal": nowhere}],
        "getMultirotorState": [7],
    }

    def sometimes(method: str) -> Any:
        good, answers, calls = server.methods[method], iter(bad[method]), 0

        def answer(*arguments: Any) -> Any:
            nonlocal calls
            calls += 1
            behaviour = next(answers, "over") if calls > 3 else "over"
            return good(*arguments) if behaviour == "over" else behaviour

        return answer

    server.methods |= {method: sometimes(method) for method in bad}
    result = fly(server, 0.4, imu_rate=50, image_rate=50)
    assert len(result.of(Odometry)) == 20  # of 21, as of images but 5
    assert {e.data.shape for e in result.of(Image)} == {(4, 8, 3)}
    assert len(result.of(Image)) == 16
    assert len(result.of(Imu)) >= 18


def test_an_unknown_vehicle_is_refused_by_name(server: FakeServer) -> None:
    with pytest.raises(
        FatalError, match=r'expected one of the server.s \(Alpha, Beta\), found "X"'
    ):
        fly(server, vehicle="X")


def test_a_server_that_is_absent_is_an_error_after_a_while() -> None:
    with FakeServer().serving() as server:
        pass  # it has gone again
    with pytest.raises(FatalError, match=r"expected a server of AirSim's at 127.0.0.1:\d+ within"):
        fly(server, start_timeout=0.3)


@pytest.mark.slow
def test_a_lost_connection_ends_the_run_if_it_is_to(server: FakeServer) -> None:
    server.methods["simContinueForTime"] = _always(HangUp)
    with pytest.raises(FatalError, match=r"the connection to 127.0.0.1:\d+ is lost"):
        fly(server)


@pytest.mark.slow
def test_a_hung_call_ends_at_its_limit(server: FakeServer) -> None:
    server.methods["simContinueForTime"] = _always(NoReply)
    with pytest.raises(FatalError, match=r"simContinueForTime: no reply in 0.3 s"):
        fly(server)


@pytest.mark.slow
@pytest.mark.parametrize("what", [HangUp, NoReply])
def test_lost_connections_are_replaced(server: FakeServer, what: type[Exception]) -> None:
    steps = 0

    def go_on(seconds: float) -> None:
        nonlocal steps
        steps += 1
        if steps == 3:
            raise what
        server.go_on(seconds)

    server.methods["simContinueForTime"] = go_on
    result = fly(server, 0.1, imu_rate=100, on_loss="reconnect")
    stamps = [e.stamp for e in result.of(Odometry)]
    assert stamps == sorted(set(stamps))
    assert stamps[-1] >= 90_000_000
    assert len(server.made("enableApiControl")) == 3  # twice at a start, once at the end


@pytest.mark.slow
@pytest.mark.parametrize("what", [HangUp, NoReply])
def test_a_hung_request_for_images_costs_one_set_of_them(
    server: FakeServer, what: type[Exception]
) -> None:
    requests = 0

    def images(*arguments: Any) -> Any:
        nonlocal requests
        requests += 1
        if requests == 3:
            raise what
        return server.images(*arguments)

    server.methods["simGetImages"] = images
    result = fly(server, 0.1, imu_rate=100, image_rate=50)
    # The first request is of before the run.
    assert [e.stamp for e in result.of(Image)] == [n * 10_000_000 for n in (0, 4, 6, 8, 10)]
    assert len(result.of(Odometry)) == 11


@pytest.mark.slow
def test_a_server_that_starts_anew_has_another_clock(server: FakeServer) -> None:
    def state(name: str) -> MultirotorState:
        if server.time == START + 30_000_000:
            server.time = 5
            raise HangUp
        return server.state(name)

    server.methods["getMultirotorState"] = state
    result = fly(server, 0.1, imu_rate=100, on_loss="reconnect")
    stamps = [e.stamp for e in result.of(Odometry)]
    assert stamps == sorted(set(stamps))
    assert stamps[-1] >= 90_000_000


@pytest.mark.slow
def test_a_clock_that_leaps_moves_no_stamps(server: FakeServer) -> None:
    def state(name: str) -> MultirotorState:
        if server.time == START + 30_000_000:
            server.time += 10**18
        return server.state(name)

    server.methods["getMultirotorState"] = state
    result = fly(server, 0.1, imu_rate=100, on_loss="reconnect")
    stamps = [e.stamp for e in result.of(Odometry)]
    assert stamps == sorted(set(stamps))
    assert 90_000_000 <= stamps[-1] <= 100_000_000
    server.time = START
    with pytest.raises(FatalError, match="clock leaps by 1e\\+09 s"):
        fly(server)


@pytest.mark.slow
def test_two_clients_cannot_lead_one_server(server: FakeServer) -> None:
    nodes = [spec(AirsimClient, name, settings(server, vehicle=name)) for name in ("Alpha", "Beta")]
    with pytest.raises(VisnavError, match="one AirsimClient for each server in lockstep"):
        run_nodes(nodes)


@pytest.mark.slow
def test_time_runs_on_after_the_run_if_it_ran_before(server: FakeServer) -> None:
    fly(server)
    assert server.made("simPause") == [[True], [False]]
    assert server.made("enableApiControl") == [[True, "Alpha"], [False, "Alpha"]]
    server.calls.clear()
    server.methods["simIsPaused"] = lambda: True
    fly(server, takeover=False)
    assert server.made("simPause") == [[True]]
    assert not server.made("enableApiControl")


def _always(what: type[Exception]) -> Any:
    def method(*_: Any) -> None:
        raise what

    return method
