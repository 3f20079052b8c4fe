"""What scripts do with a real client: run by the client's own Python, in a process of its own.

    python client_side.py MODULE PORT FUNCTION [ARGUMENT …]

The function's result is printed as JSON in the last line. No import of this project here.
"""

from __future__ import annotations

import importlib
import inspect
import json
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

airsim: Any = importlib.import_module(sys.argv[1]) if len(sys.argv) > 1 else None
IS_COSYS = sys.argv[1:2] == ["cosysairsim"]


def connect(port: int) -> Any:
    """Return a client that may fly."""
    client = airsim.MultirotorClient(port=port)
    client.confirmConnection()
    client.enableApiControl(True)
    client.armDisarm(True)
    return client


def position(client: Any, vehicle: str = "") -> list[float]:
    """Return where a vehicle is, local NED."""
    return list(client.getMultirotorState(vehicle).kinematics_estimated.position.to_numpy_array())


def handshake(port: int) -> Any:
    """Connect, and ask what there is."""
    client = airsim.MultirotorClient(port=port)
    client.confirmConnection()
    return {"ping": client.ping(), "vehicles": client.listVehicles()}


def hello(port: int) -> Any:
    """Fly as the first script of everybody does."""
    client = connect(port)
    readings: dict[str, Any] = {"start": position(client)}
    readings["landed"] = [client.getMultirotorState().landed_state]
    client.takeoffAsync().join()
    readings["up"] = position(client)
    readings["landed"].append(client.getMultirotorState().landed_state)
    client.moveToPositionAsync(2, 1, -2.5, 2).join()
    readings["there"] = position(client)
    client.rotateToYawAsync(90).join()
    orientation = client.getMultirotorState().kinematics_estimated.orientation
    angles = airsim.quaternion_to_euler_angles if IS_COSYS else airsim.to_eularian_angles
    readings["yaw"] = float(np.degrees(angles(orientation)[2]))
    client.moveOnPathAsync(
        [airsim.Vector3r(2, -1, -2.5), airsim.Vector3r(0, 0, -1)],
        2,
        120,
        airsim.DrivetrainType.ForwardOnly,
        airsim.YawMode(False, 0),
    ).join()
    readings["back"] = position(client)
    client.hoverAsync().join()
    client.landAsync().join()
    readings["down"] = position(client)
    readings["landed"].append(client.getMultirotorState().landed_state)
    client.armDisarm(False)
    client.enableApiControl(False)
    return readings


def unjoined(port: int) -> Any:
    """Let a velocity go on while the script sleeps, as most scripts do."""
    client = connect(port)
    client.takeoffAsync().join()
    before = position(client)
    client.moveByVelocityAsync(1, 0, 0, 1.5)
    if IS_COSYS:
        client.ping()  # its client sends a call when it next turns
    time.sleep(0.6)
    moving = client.getMultirotorState().kinematics_estimated.linear_velocity.x_val
    time.sleep(2.5)
    state = client.getMultirotorState().kinematics_estimated
    return {
        "moving": moving,
        "still": state.linear_velocity.get_length(),
        "distance": state.position.x_val - before[0],
    }


def superseded(port: int) -> Any:
    """Give a task while another is under way, and note in which order they end."""
    client = connect(port)
    client.takeoffAsync().join()
    far = client.moveToPositionAsync(30, 0, -2, 1)
    began = client.getMultirotorState().timestamp
    near = client.moveByVelocityAsync(0, 1, 0, 0.5)
    ended = []
    for task in (far, near):
        task.join()
        ended.append((client.getMultirotorState().timestamp - began) / 1e9)
    return {"far": far.result, "near": near.result, "ended": ended}


def two(port: int) -> Any:
    """Fly two drones at a time."""
    client = airsim.MultirotorClient(port=port)
    client.confirmConnection()
    names = client.listVehicles()
    for name in names:
        client.enableApiControl(True, name)
        client.armDisarm(True, name)
    for flight in [client.takeoffAsync(vehicle_name=name) for name in names]:
        flight.join()
    moves = [
        client.moveToPositionAsync(1 + i, 0, -2, 1, vehicle_name=name)
        for i, name in enumerate(names)
    ]
    for move in moves:
        move.join()
    return {"names": names, "where": {name: position(client, name) for name in names}}


def stepped(port: int) -> Any:
    """Fly by steps of paused time; the stamps tell how long each took."""
    client = connect(port)
    client.simPause(True)
    stamps = [client.getMultirotorState().timestamp]
    take_off = client.takeoffAsync()
    for _ in range(40):
        client.simContinueForTime(0.25)
        stamps.append(client.getMultirotorState().timestamp)
    take_off.join()
    before = position(client)
    time.sleep(0.5)
    return {
        "stamps": stamps,
        "paused": client.simIsPause(),
        "where": before,
        "later": position(client),
    }


def again(port: int) -> Any:
    """Reset in the air, and fly once more."""
    client = connect(port)
    client.takeoffAsync().join()
    client.moveToPositionAsync(2, 2, -3, 2)
    client.reset()
    readings = {"reset": position(client), "control": client.isApiControlEnabled()}
    client.enableApiControl(True)
    client.armDisarm(True)
    client.takeoffAsync().join()
    readings["up"] = position(client)
    return readings


def collision(port: int) -> Any:
    """Fly into the crate's side, and read of it twice."""
    client = connect(port)
    client.takeoffAsync().join()
    client.simGetCollisionInfo()
    client.moveToZAsync(-0.4, 1).join()
    first = client.simGetCollisionInfo()
    client.moveByVelocityZAsync(1.5, 0, -0.4, 4).join()
    infos = [client.simGetCollisionInfo() for _ in range(2)]
    return {
        "before": first.has_collided,
        "has": [info.has_collided for info in infos],
        "object": infos[0].object_name,
        "normal": list(infos[0].normal.to_numpy_array()),
    }


def errors(port: int) -> Any:
    """Call what cannot be served."""
    client = airsim.MultirotorClient(port=port)
    refused = []

    def attempt(call: Any) -> None:
        try:
            call()
        except Exception as error:  # msgpackrpc.error.RPCError, of two packages
            text = error.args[0] if error.args else ""
            refused.append(text.decode() if isinstance(text, bytes) else str(text))
        else:
            refused.append("")

    attempt(lambda: client.client.call("simNonsense", 1))
    attempt(lambda: client.client.call("simPause"))
    attempt(lambda: client.getMultirotorState("nobody"))
    attempt(lambda: client.getImuData("nothing"))
    attempt(lambda: client.simGetImages([airsim.ImageRequest("nowhere", 0)]))
    client.takeoffAsync(vehicle_name="nobody").join()  # never raises
    future = client.takeoffAsync()  # without control
    future.join()
    attempt(future.get)
    return {"refused": refused, "alive": client.ping()}


def every_method(port: int) -> Any:
    """Call each method of the client once, if it is known with what; return all errors."""
    client = connect(port)
    client.takeoffAsync().join()
    place, here = airsim.GeoPoint(), airsim.Vector3r(0.5, 0, -2)
    pose = airsim.Pose(here, airsim.Quaternionr(0, 0, 0, 1))
    given: dict[str, Any] = {
        "requests": [airsim.ImageRequest("0", 0)],
        "path": [here],
        "poses": [pose],
        "pose": pose,
        "state": client.simGetGroundTruthKinematics(),
        "color_rgba": [1.0, 0.0, 0.0, 1.0],
        "distortion_params": {"K1": 0.0},
        "param_name": "K1",
        "z": -2,
        "fov_degrees": 80,
        "is_name_regex": False,
    }
    of_kinds: list[tuple[Any, str]] = [
        (0.0, "y vy vz roll pitch roll_rate pitch_rate yaw_rate value val scale"),
        (0, "image_type param"),
        (0.5, "x vx yaw throttle front_right_pwm rear_left_pwm front_left_pwm rear_right_pwm"),
        (1, "duration velocity object_id seconds frames radius_cm"),
        (True, "enable is_enabled status ignore_collision ignore_collison"),
        ("crate", "object_name mesh_name asset_name message command level_name name_regex"),
        ("0", "camera_name"),
        (47.6414, "latitude"),
        (-122.14, "longitude"),
        (124, "altitude"),
        (here, "wind scale_vector scale_vec"),
        ([here], "points points_start points_end positions"),
        (["a"], "strings names tf_names"),
        (place, "geo_point point point1 point2"),
    ]
    given |= {name: value for value, names in of_kinds for name in names.split()}
    called, errors = [], {}
    for name, method in sorted(inspect.getmembers(client, inspect.ismethod)):
        needed = [
            parameter_name
            for parameter_name, parameter in inspect.signature(method).parameters.items()
            if parameter.default is inspect.Parameter.empty
        ]
        if name.startswith("_") or name == "reset" or not set(needed) <= given.keys():
            continue
        called.append(name)
        try:
            result: Any = method(*[given[parameter] for parameter in needed])
            if name.endswith("Async"):
                result.get()
        except Exception as error:  # as in `errors`
            text = error.args[0] if error.args else ""
            errors[name] = text.decode() if isinstance(text, bytes) else repr(error)
        if client.simIsPause():
            client.simPause(False)
    return {"called": called, "errors": errors}


def sensors(port: int) -> Any:
    """Read every sensor."""
    client = connect(port)
    client.simPause(True)
    client.simContinueForTime(5.0)  # a satellite receiver needs three seconds
    points = np.array(client.getLidarData().point_cloud).reshape(-1, 3)
    imu = client.getImuData()
    gps = client.getGpsData()
    state = client.getMultirotorState()
    return {
        "imu": list(imu.linear_acceleration.to_numpy_array()),
        "imu_stamp": imu.time_stamp,
        "pressure": client.getBarometerData().pressure,
        "field": list(client.getMagnetometerData().magnetic_field_body.to_numpy_array()),
        "fix": gps.gnss.fix_type,
        "latitude": gps.gnss.geo_point.latitude,
        "home": client.getHomeGeoPoint().latitude,
        "state_stamp": state.timestamp,
        "distance": client.getDistanceSensorData().distance,
        "points": len(points),
        "lowest": float(points[:, 2].max()),
        "environment": client.simGetGroundTruthEnvironment().air_pressure,
    }


def images(port: int, folder: str) -> Any:
    """Take one image of each kind in paused time, and keep them beside what the run keeps."""
    client = connect(port)
    client.simPause(True)
    client.simContinueForTime(1.0)
    requests = [
        airsim.ImageRequest("front_center", airsim.ImageType.Scene, False, False),
        airsim.ImageRequest("front_center", airsim.ImageType.Scene, False, True),
        airsim.ImageRequest("front_center", airsim.ImageType.DepthPlanar, True, False),
        airsim.ImageRequest("front_center", airsim.ImageType.DepthPerspective, True, False),
        airsim.ImageRequest("front_center", airsim.ImageType.DepthVis, True, False),
        airsim.ImageRequest("front_center", airsim.ImageType.DisparityNormalized, True, False),
        airsim.ImageRequest("front_center", airsim.ImageType.Segmentation, False, False),
        airsim.ImageRequest("front_center", airsim.ImageType.SurfaceNormals, False, False),
        airsim.ImageRequest("front_center", airsim.ImageType.Infrared, False, False),
    ]
    import cv2  # of the client's environment

    stamps, sizes, poses = [], [], []
    for number, response in enumerate(client.simGetImages(requests)):
        if response.pixels_as_float:
            array = airsim.get_pfm_array(response)
        elif response.compress:
            bytes_ = airsim.string_to_uint8_array(response.image_data_uint8)
            array = cv2.imdecode(bytes_, cv2.IMREAD_UNCHANGED)
        else:
            flat = np.frombuffer(response.image_data_uint8, np.uint8)
            array = flat.reshape(response.height, response.width, 3)
        np.save(Path(folder) / f"{number}.npy", array)
        stamps.append(response.time_stamp)
        sizes.append((response.width, response.height))
        where, turn = response.camera_position, response.camera_orientation
        poses.append([*where.to_numpy_array(), *turn.to_numpy_array()])
    png = client.simGetImage("0", airsim.ImageType.Scene)
    info = client.simGetCameraInfo("front_center")
    state = client.simGetGroundTruthKinematics()
    return {
        "stamps": [int(stamp) for stamp in stamps],
        "sizes": sizes,
        "poses": [[float(number) for number in pose] for pose in poses],
        "png": len(png),
        "fov": info.fov,
        "vehicle": [float(number) for number in state.position.to_numpy_array()],
    }


def computer_vision(port: int, folder: str) -> Any:
    """Set poses of a camera without a vehicle, and take an image at each."""
    client = airsim.VehicleClient(port=port)
    client.confirmConnection()
    views = []
    for number, x in enumerate((0.0, 1.0, 2.0)):
        turn = airsim.Quaternionr(0, 0, 0, 1)
        client.simSetVehiclePose(airsim.Pose(airsim.Vector3r(x, 0.5, -1.0), turn), True)
        responses = client.simGetImages(
            [
                airsim.ImageRequest("0", airsim.ImageType.Scene, False, False),
                airsim.ImageRequest("0", airsim.ImageType.DepthPlanar, True, False),
            ]
        )
        pose = client.simGetVehiclePose()
        depth = airsim.get_pfm_array(responses[1])
        np.save(Path(folder) / f"depth{number}.npy", depth)
        views.append(
            {
                "pose": [float(coordinate) for coordinate in pose.position.to_numpy_array()],
                "image": [float(r.camera_position.x_val) for r in responses],
                "depth": float(depth[depth.shape[0] // 2, depth.shape[1] // 2]),
            }
        )
    return views


def threads(port: int) -> Any:
    """Poll by one client in each of several threads, as scripts do."""
    counts: list[int] = []

    def poll() -> None:
        import asyncio

        asyncio.set_event_loop(asyncio.new_event_loop())  # rpc-msgpack's tornado asks for one
        client = airsim.MultirotorClient(port=port)
        for _ in range(20):
            client.getMultirotorState()
        counts.append(20)

    pollers = [threading.Thread(target=poll) for _ in range(4)]
    for poller in pollers:
        poller.start()
    for poller in pollers:
        poller.join()
    return counts


if __name__ == "__main__":
    _, _, number_, name_, *rest_ = sys.argv
    print(json.dumps(globals()[name_](int(number_), *rest_), default=float))
