"""What settings.json means as a configuration of ours, and what of it is not honoured."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import visnav_airsim
from runtime.config.reading import parse
from runtime.errors import ConfigError
from sims.computer_vision import FreeCamera
from sims.multirotor import Multirotor, MultirotorConfig
from visnav_airsim.server import AirsimServer, AirsimServerConfig
from visnav_airsim.settings import read

PACKAGE = Path(visnav_airsim.__file__).parent


def table_of(settings: Any, expected_notes: int | None = 0) -> tuple[dict[str, Any], list[str]]:
    """Return the table of some settings, and what was said; also that our own checks take it."""
    notes: list[str] = []
    table = read(json.dumps(settings), "settings.json", notes.append)
    parse(table, "settings.json")
    assert expected_notes is None or len(notes) == expected_notes, notes
    return table, notes


def node(settings: Any, name: str, notes: int | None = 0) -> Any:
    """Return the settings of a node, as our own types have them."""
    config = parse(table_of(settings, notes)[0], "settings.json")
    return next(spec.config for spec in config.nodes if spec.name == name)


def drone(**settings: Any) -> dict[str, Any]:
    return {"Vehicles": {"Drone1": {"VehicleType": "SimpleFlight", **settings}}}


def lidar(**settings: Any) -> dict[str, Any]:
    return drone(Sensors={"L": {"SensorType": 6, "Enabled": True, **settings}})


@pytest.mark.parametrize("settings", [{}, {"SimMode": ""}, {"Vehicles": {}}, {"Vehicles": None}])
def test_without_settings_there_is_a_drone_with_airsims_sensors(settings: Any) -> None:
    config = parse(table_of(settings)[0], "settings.json")
    assert config.run.clock == "lockstep"
    assert config.run.speed == 1.0
    vehicle, server = config.nodes
    assert (vehicle.name, vehicle.node) == ("SimpleFlight", Multirotor)
    assert isinstance(vehicle.config, MultirotorConfig)
    imu = vehicle.config.imu
    assert imu.gyroscope_noise_density == pytest.approx(8.7266e-5, rel=1e-4)
    assert imu.gyroscope_random_walk == pytest.approx(9.9735e-7, rel=1e-4)
    assert imu.accelerometer_noise_density == pytest.approx(2.3536e-3, rel=1e-4)
    assert imu.accelerometer_random_walk == pytest.approx(1.2482e-5, rel=1e-4)
    sensors: Any = vehicle.config  # a table for each of the sensors that there are
    assert sensors.barometer.model == "airsim"
    assert sensors.magnetometer is not None
    assert sensors.gnss.latency == 0.2
    assert not vehicle.config.range_finders
    assert server.node is AirsimServer
    assert isinstance(server.config, AirsimServerConfig)
    assert (server.config.host, server.config.port) == ("127.0.0.1", 41451)
    assert json.loads(server.config.settings) == settings


def test_vehicles_come_sorted_with_their_starts() -> None:
    settings = {
        "Vehicles": {
            "B": {"VehicleType": "simpleflight", "X": 2, "Y": -1, "Z": -0.5, "Yaw": 90},
            "A": {"VehicleType": "SimpleFlight", "IsFpvVehicle": True, "X": 1},
            "C": {"VehicleType": "SimpleFlight", "AutoCreate": False},
        }
    }
    config = parse(table_of(settings)[0], "settings.json")
    assert [spec.name for spec in config.nodes] == ["A", "B", "airsim"]
    b = node(settings, "B")
    assert (b.position, b.height, b.yaw) == ((2.0, -1.0), 0.5, 90.0)
    assert node(settings, "airsim").default_vehicle == "A"


def test_the_computer_vision_mode_has_a_camera_that_flies_freely() -> None:
    settings = {"SimMode": "ComputerVision", "Vehicles": {"Eye": {"Z": -2, "Pitch": -30}}}
    config = parse(table_of(settings)[0], "settings.json")
    assert config.nodes[0].node is FreeCamera
    eye = node(settings, "Eye")
    assert (eye.position, eye.orientation) == ((0.0, 0.0, -2.0), (0.0, -30.0, 0.0))
    assert node({"SimMode": "ComputerVision"}, "ComputerVision").position == (0.0, 0.0, -1.5)


def test_a_camera_without_a_vehicle_names_the_sensors_that_it_lacks() -> None:
    sensors = {
        "Top": {"SensorType": 6, "Enabled": True, "Range": 20},
        "Imu1": {"SensorType": 2, "Enabled": True},
        "Off": {"SensorType": 1, "Enabled": False},
    }
    eye = {"SimMode": "ComputerVision", "Vehicles": {"Eye": {"Sensors": sensors}}}
    (note,) = table_of(eye, 1)[1]
    assert note.startswith("settings.json: Vehicles.Eye.Sensors: ignored: Imu1, Top: ")
    assert "cameras and no other sensor" in note
    usual = {"SimMode": "ComputerVision", "DefaultSensors": sensors}
    (note,) = table_of(usual, 1)[1]
    assert note.startswith("settings.json: DefaultSensors: ignored: Imu1, Top: ")
    del sensors["Top"], sensors["Imu1"]
    table_of(eye, 0)


def test_a_lidars_cycle_is_measured_as_cosys_airsim_does() -> None:
    top = {"SensorType": 6, "Enabled": True, "NumberOfChannels": 32, "MeasurementsPerCycle": 512}
    noise = {"GenerateNoise": True, "MinNoiseStandardDeviation": 0.02}
    (lidar,) = node(drone(Sensors={"Top": top}), "Drone1").lidars
    assert (lidar.columns, lidar.rate, lidar.azimuths, lidar.noise) == (
        512,
        10.0,
        (0.0, 360.0),
        0.0,
    )
    narrow = top | noise | {"HorizontalFOVStart": -30, "HorizontalFOVEnd": 30}
    (lidar,) = node(drone(Sensors={"Top": narrow}), "Drone1").lidars
    assert (lidar.columns, lidar.azimuths, lidar.noise) == (512, (330.0, 390.0), 0.02)
    quiet = top | noise | {"GenerateNoise": False, "NoiseDistanceScale": 2}
    (lidar,) = node(drone(Sensors={"Top": quiet}), "Drone1", notes=None).lidars
    assert lidar.noise == 0.0


def test_the_whole_file() -> None:
    settings = {
        "ClockSpeed": 2,
        "ApiServerPort": 41999,
        "LocalHostIp": "0.0.0.0",
        "Wind": {"X": 3.0},
        "OriginGeopoint": {"Latitude": 10.0, "Longitude": 20, "Altitude": 30},
    }
    config = parse(table_of(settings)[0], "settings.json")
    assert config.run.speed == 2.0
    assert node(settings, "airsim").port == 41999
    assert node(settings, "airsim").host == "0.0.0.0"
    assert node(settings, "world").wind.velocity == (3.0, 0.0, 0.0)
    assert node(settings, "SimpleFlight").origin == (10.0, 20.0, 30.0)


def test_sensors_are_mapped_with_units() -> None:
    sensors = {
        "Imu1": {"SensorType": 2, "Enabled": True, "AngularRandomWalk": 0.6, "X": 0.1},
        "Baro": {"SensorType": 1, "Enabled": False},
        "Gps1": {"SensorType": 3, "Enabled": True, "EPH_TimeConstant": 2, "UpdateLatency": 1.5},
        "Mag": {"SensorType": 4, "Enabled": True, "NoiseSigma": 0.01, "UpdateFrequency": 20},
        "Down": {"SensorType": 5, "Enabled": True, "Pitch": -90, "MaxDistance": 10.5},
        "Top": {
            "SensorType": 6,
            "Enabled": True,
            "NumberOfChannels": 32,
            "PointsPerSecond": 64000,
            "RotationsPerSecond": 5,
            "HorizontalFOVStart": -90,
            "HorizontalFOVEnd": 90,
            "VerticalFOVUpper": 10,
            "Range": 50,
            "Z": -0.2,
        },
    }
    config = node(drone(Sensors=sensors), "Drone1")
    assert config.imu.gyroscope_noise_density == pytest.approx(2 * 8.7266e-5, rel=1e-4)
    assert config.imu.position == (0.1, 0.0, 0.0)
    assert config.barometer is None
    assert (config.gnss.eph_time_constant, config.gnss.latency) == (2.0, 1.5)
    assert (config.magnetometer.noise, config.magnetometer.rate) == (pytest.approx(1e-6), 20.0)
    (down,) = config.range_finders
    assert (down.name, down.orientation, down.noise) == ("Down", (0.0, -90.0, 0.0), 0.2)
    assert (down.min_range, down.max_range) == (0.2, 10.5)
    (top,) = config.lidars
    assert (top.channels, top.columns, top.rate, top.max_range) == (32, 400, 5.0, 50.0)
    assert (top.azimuths, top.elevations) == ((270.0, 450.0), (-45.0, 10.0))
    assert top.position == (0.0, 0.0, -0.2)
    server = node(drone(Sensors=sensors), "airsim")
    assert server.sensor_names == {
        "gps": "gnss",
        "Imu1": "imu",
        "Gps1": "gnss",
        "Mag": "magnetometer",
    }


def test_lidars_are_called_by_airsims_names_and_give_points_in_the_frame_asked_for() -> None:
    lidar = {"SensorType": 6, "Enabled": True, "DataFrame": "SensorLocalFrame"}
    settings = drone(Sensors={"Lidar 1": lidar})
    assert node(settings, "Drone1").lidars[0].name == "Lidar_1"
    server = node(settings, "airsim")
    assert server.sensor_names == {"gps": "gnss", "Lidar 1": "Lidar_1"}
    assert server.lidar_frame == "SensorLocalFrame"


def test_cameras_keep_airsims_defaults_where_nothing_is_said() -> None:
    captures = [{"ImageType": 0, "Width": 640}, {"ImageType": 1, "FOV_Degrees": 60}]
    settings = drone(
        Cameras={
            "eye": {"X": 0.5, "Pitch": -10, "CaptureSettings": [{"ImageType": 1}]},
            "front_left": {"NoiseSettings": [{"Enabled": False}]},
            "front_right": {"X": 0.5, "CaptureSettings": []},
        }
    ) | {"CameraDefaults": {"CaptureSettings": captures}}
    cameras = {camera.name: camera for camera in node(settings, "airsim", 3).cameras}
    assert set(cameras) == {
        "eye",
        "front_center",
        "front_right",
        "front_left",
        "bottom_center",
        "back_center",
    }
    scene, depth = cameras["eye"].captures
    assert (scene.width, scene.height, scene.fov) == (640, 144, 90.0)
    assert (depth.image_type, depth.width, depth.fov) == (1, 256, 90.0)  # replaced as a whole
    assert cameras["eye"].position == (0.5, 0.0, 0.0)
    assert cameras["eye"].orientation == (0.0, -10.0, 0.0)
    assert cameras["front_left"].position is None
    assert cameras["front_right"].position == (0.5, 0.125, 0.0)
    assert cameras["front_left"].captures[1].fov == 60.0
    assert cameras["back_center"].vehicle == "Drone1"
    settings["CameraDefaults"] = {"Y": 0.2, "Yaw": 5}
    cameras = {camera.name: camera for camera in node(settings, "airsim").cameras}
    assert cameras["eye"].position == (0.5, 0.2, 0.0)
    assert cameras["eye"].orientation == (0.0, -10.0, 5.0)
    assert cameras["front_left"].position == (0.46, 0.2, 0.0)


def test_recordings_stay_in_the_runs_folder() -> None:
    images = [{"CameraName": "eye", "ImageType": 1, "PixelsAsFloat": True}]
    settings = {"Recording": {"RecordInterval": 0.2, "Folder": "/a/../b c", "Cameras": images}}
    recording = node(settings, "airsim", 1).recording
    assert (recording.interval, recording.folder) == (0.2, "b_c")
    assert recording.images[0].camera == "eye"
    assert recording.images[0].pixels_as_float
    assert node({"Recording": {}}, "airsim").recording == node({}, "airsim").recording


@pytest.mark.parametrize(
    ("start", "end", "azimuths"),
    [(0, 359, (0, 359)), (0, 360, (0, 360)), (-180, 180, (180, 540)), (-30, 30, (330, 390))],
)
def test_a_lidars_field_of_view_wraps_round(start: float, end: float, azimuths: Any) -> None:
    lidar = {"SensorType": 6, "Enabled": True, "HorizontalFOVStart": start, "HorizontalFOVEnd": end}
    assert node(drone(Sensors={"L": lidar}), "Drone1").lidars[0].azimuths == azimuths


def test_default_sensors_replace_the_built_in_ones() -> None:
    settings = drone() | {"DefaultSensors": {"B": {"SensorType": 1, "Enabled": True}}}
    config = node(settings, "Drone1")
    assert config.barometer is not None
    assert config.gnss is None
    assert config.magnetometer is None
    assert config.imu.gyroscope_noise_density == pytest.approx(8.7266e-5, rel=1e-4)


def test_cosys_imus_are_without_noise_unless_asked() -> None:
    imu = {"SensorType": 2, "Enabled": True, "GenerateNoise": False}
    assert node(drone(Sensors={"I": imu}), "Drone1").imu.ideal


@pytest.mark.parametrize(
    ("settings", "note"),
    [
        ({"ViewMode": "NoDisplay"}, "ViewMode: ignored: it changes only what Unreal shows"),
        ({"ClokSpeed": 2}, "ClokSpeed: ignored: no such setting is known (did you mean 'Clock"),
        ({"ClockSpeed": 1.5}, "ClockSpeed: AirSim takes 1.5 as 1; here it is 1.5"),
        (
            drone(Cameras={"c": {"Gimbal": {"Stabilization": 1}}}),
            "Cameras.c.Gimbal: ignored: cameras turn with their vehicle",
        ),
        (drone(RC={"RemoteControlID": 0}), "Vehicles.Drone1.RC: ignored: clients may always"),
        (drone(Sensors={"G": {"SensorType": 3}}), "Sensors.G: ignored: a sensor is off unless"),
        (drone(Sensors={"G": {"SensorType": 7}}), "Sensors.G.SensorType: ignored: no sensor of"),
        (
            drone(Cameras={"c": {"CaptureSettings": [{"Width": 640}]}}),
            "Cameras.c.CaptureSettings: depth, which is not listed, has 256×144 pixels of 90°",
        ),
        (
            drone(Cameras={"c": {"NoiseSettings": [{}, {"Enabled": True}]}}),
            "Cameras.c.NoiseSettings[1]: ignored: images on demand are without errors",
        ),
        (
            {"CameraDefaults": {"CaptureSettings": [{"ImageType": -1}]}},
            "CameraDefaults.CaptureSettings[0].ImageType: ignored: no images of type -1 are taken",
        ),
        (
            drone(Sensors={n: {"SensorType": 3, "Enabled": True} for n in "GH"}),
            "Vehicles.Drone1.Sensors.H: ignored: a vehicle has one gnss",
        ),
        (
            lidar(MeasurementsPerCycle=512, PointsPerSecond=1e5),
            "Sensors.L.PointsPerSecond: ignored: MeasurementsPerCycle is given, too",
        ),
        (
            lidar(GenerateNoise=True, MinNoiseStandardDeviation=0.1, NoiseDistanceScale=3),
            "Sensors.L.NoiseDistanceScale: ignored: the noise is the same at all distances",
        ),
        (
            lidar(External=True, ExternalLocal=True),
            "Sensors.L.External: ignored: vehicles carry all cameras and sensors",
        ),
        (
            drone(Sensors={"G": {"SensorType": 8, "Enabled": True}}),
            "G.SensorType: ignored: no sensor of type 8 (lidar on a GPU; 6 is a lidar) is",
        ),
        ({"SettingsVersion": 1.0}, "SettingsVersion: 1 is read as if it were 1.2"),
        (drone(DefaultVehicleState="Disarmed"), "Drone1.DefaultVehicleState: ignored: it starts"),
        ({"a\nb": 1}, r"settings.json: a\nb: ignored"),
    ],
)
def test_what_is_not_honoured_is_named_once_with_its_path(settings: Any, note: str) -> None:
    (remark,) = table_of(settings, 1)[1]
    assert note in remark
    assert remark.startswith("settings.json: ")


def test_what_asks_for_what_is_so_anyway_is_not_named() -> None:
    gimbal = {"Stabilization": 0, "Pitch": float("nan")}
    settings = drone(
        DefaultVehicleState="Armed",
        EnableCollisions=True,
        EnableCollisionPassthrogh=False,
        AllowAPIAlways=True,
        PawnPath="",
        X=float("nan"),
    ) | {"ClockType": "", "RpcEnabled": True, "CameraDefaults": {"Gimbal": gimbal, "X": None}}
    assert not [note for note in table_of(settings, None)[1] if "NaN" not in note]


def test_vehicles_at_one_place_are_named() -> None:
    vehicles = {name: {"VehicleType": "SimpleFlight"} for name in "ab"}
    notes = table_of({"Vehicles": vehicles}, 2)[1]
    assert notes[0] == "settings.json: Vehicles.a: another vehicle starts at the same place"


@pytest.mark.parametrize(
    ("settings", "error"),
    [
        ({"SimMode": "Car"}, 'SimMode: expected "Multirotor" or "ComputerVision", found \'Car\''),
        (drone(VehicleType="PX4Multirotor"), "'PX4Multirotor': PX4 would have to run beside it"),
        (drone(VehicleType="PhysXCar"), "found 'PhysXCar': cars are not simulated"),
        ({"Vehicles": {"A": {}}}, "Vehicles.A.VehicleType: expected"),
        ({"Vehicles": {"A": {"AutoCreate": False, "VehicleType": "SimpleFlight"}}}, "AutoCreate"),
        ({"Vehicles": {"1 a": {"VehicleType": "SimpleFlight"}}}, "expected a letter, then letters"),
        ({"Vehicles": [1]}, "settings.json: Vehicles: expected an object, found [1]"),
        (drone(X="1"), "Vehicles.Drone1.X: expected a finite number, found '1'"),
        (drone(X=True), "Vehicles.Drone1.X: expected a finite number, found True"),
        (drone(X=float("inf")), "Vehicles.Drone1.X: expected a finite number, found inf"),
        (drone(X=10**400), "Vehicles.Drone1.X: expected a finite number, found 1000"),
        ({"ClockSpeed": 0}, "ClockSpeed: expected a number above 0, found 0"),
        ({"ApiServerPort": 1.5}, "ApiServerPort: expected a whole number, found 1.5"),
        ({"ApiServerPort": 70000}, "port: expected"),
        (drone(Sensors={"I": {"SensorType": 2, "Enabled": 1}}), "Sensors.I.Enabled: expected true"),
        (
            drone(Sensors={"I": {"SensorType": 2, "Enabled": True, "GyroBiasStabilityTau": 0}}),
            "Sensors.I.GyroBiasStabilityTau: expected a number above 0, found 0",
        ),
        (
            drone(Cameras={"c": {"CaptureSettings": [{"ProjectionMode": "orthographic"}]}}),
            "CaptureSettings[0].ProjectionMode: expected \"perspective\", found 'orthographic'",
        ),
        (
            lidar(MeasurementsPerCycle=0),
            "Sensors.L.MeasurementsPerCycle: expected 1 to 65536, found 0",
        ),
        (drone(Cameras={"c": {"CaptureSettings": [{"FOV_Degrees": 175}]}}), "fov: expected"),
        ({"OriginGeopoint": {"Latitude": 100}}, "origin"),
    ],
)
def test_what_is_wrong_is_refused_with_its_path(settings: Any, error: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(error)):
        table_of(settings, None)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=4,
)
KNOWN = sorted(
    {
        word
        for file in map(PACKAGE.joinpath, ("settings.py", "keys.py"))
        for word in re.findall(r'"([A-Z]\w+)"', file.read_text())
    }
    | set("XYZ")
)


def objects(inner: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    return st.dictionaries(st.sampled_from(KNOWN), inner | JSON, max_size=6)


SETTINGS = st.fixed_dictionaries(
    {},
    optional={
        "Vehicles": st.dictionaries(
            st.sampled_from(["A", "B", "airsim", ""]),
            st.builds(
                lambda known, type_: known | {"VehicleType": type_},
                objects(
                    st.dictionaries(
                        st.text(max_size=2), objects(st.lists(objects(JSON), max_size=2))
                    )
                ),
                st.sampled_from(["SimpleFlight", "ComputerVision"]),
            ),
            max_size=2,
        ),
        "CameraDefaults": objects(st.lists(objects(JSON), max_size=2)),
        "Recording": objects(st.lists(objects(JSON), max_size=2)),
        "SimMode": st.sampled_from(["", "Multirotor", "ComputerVision", "Car"]),
    },
).flatmap(lambda known: objects(JSON).map(lambda more: more | known))


@pytest.mark.slow
@given(SETTINGS | JSON)
def test_any_settings_are_refused_or_load(settings: Any) -> None:
    try:
        table_of(settings, None)
    except ConfigError as error:
        refused = str(error)
        assert "\n" not in refused
