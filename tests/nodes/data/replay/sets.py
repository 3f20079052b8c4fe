"""One small recording in each format: what `test_readers` reads, with what must come of it."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from events import Announcement, Event
from nodes.data.dataset import DatasetWriter
from nodes.data.mcap.mcap_file import McapWriter
from nodes.data.recorder.process import EventWriter
from nodes.data.recorder.writer_process import McapRecorderConfig
from nodes.data.replay.node import open_reader
from nodes.data.replay.reader import Reader, ReplayConfig
from runtime.channels.wire import pack
from runtime.testing import run_node
from tests.nodes.data.dataset.samples import flight
from tests.nodes.data.recorder.samples import announcements

EPOCH = 1_700_000_000
FRAMES = 3
STEP = 30_000_000


def events() -> list[Event]:
    """Return announcements, and a frame of everything each 30 ms, published at once."""
    return [announcements()[0], *flight(FRAMES)]


def recording(folder: Path, **settings: Any) -> Path:
    path = folder / "recording.mcap"
    writer = McapWriter(path)
    topics = EventWriter(writer, McapRecorderConfig(**settings), lambda _: None)
    for event in events():
        topics.write(event.stamp, pack(event).frame(), isinstance(event, Announcement))
        if event.stamp:
            writer.end_chunk()
    writer.close({"visnav": {"end": str(events()[-1].stamp)}})
    return path


def torn(folder: Path) -> Path:
    """Return a recording of which the end is missing: the index, not the data."""
    path = recording(folder)
    data = path.read_bytes()
    path.write_bytes(data[: data.index(b"\x0f\x04" + bytes(7))])
    return path


def bag(folder: Path, plugin: StoragePlugin = StoragePlugin.SQLITE3, **settings: Any) -> Path:
    """Return the same as a robot would record it: in this century, and without our own topics."""
    path, store = folder / f"bag_{plugin.name}", get_typestore(Stores.ROS2_JAZZY)
    with (
        AnyReader([recording(folder, **settings)]) as reader,
        Writer(path, version=9, storage_plugin=plugin) as writer,
    ):
        said = [c for c in reader.connections if not c.topic.startswith(("/visnav", "/scores"))]
        known = {c.id: writer.add_connection(c.topic, c.msgtype, typestore=store) for c in said}
        for connection, time, data in reader.messages(said):
            message = bytearray(data)
            if connection.topic not in {"/tf", "/tf_static"}:
                (seconds,) = struct.unpack_from("<i", message, 4)
                struct.pack_into("<i", message, 4, seconds + EPOCH)
            writer.write(known[connection.id], time + EPOCH * 1_000_000_000, bytes(message))
    return path


def mcap_bag(folder: Path) -> Path:
    return next(bag(folder, StoragePlugin.MCAP).glob("*.mcap"))


def compressed_bag(folder: Path) -> Path:
    return bag(folder, image_format="png", depth_format="png")


def dataset(folder: Path, layout: str) -> Path:
    run_node(DatasetWriter, inputs=flight(FRAMES), config={"format": layout}, out=folder)
    return folder / "dataset"


def euroc(folder: Path) -> Path:
    return dataset(folder, "euroc")


def tum_rgbd(folder: Path) -> Path:
    return dataset(folder, "tum_rgbd")


def euroc_as_published(folder: Path) -> Path:
    """Return a data set as projects.asl.ethz.ch/datasets has it: heads, spaces and figures."""
    root = folder / "MH_01_easy" / "mav0"
    (root / "cam0" / "data").mkdir(parents=True)
    (root / "imu0").mkdir()
    (root / "state_groundtruth_estimate0").mkdir()
    (root / "cam0" / "sensor.yaml").write_text(
        "#Default calibration.\n# General sensor definitions.\nsensor_type: camera\n"
        "comment: VI-Sensor cam0 (MT9M034)\n\n# Sensor extrinsics wrt. the body-frame.\n"
        "T_BS:\n  cols: 4\n  rows: 4\n"
        "  data: [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975,\n"
        "         0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768,\n"
        "        -0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949,\n"
        "         0.0, 0.0, 0.0, 1.0]\n\n# Camera specific definitions.\nrate_hz: 20\n"
        "resolution: [752, 480]\ncamera_model: pinhole\n"
        "intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv\n"
        "distortion_model: radial-tangential\n"
        "distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]\n"
    )
    first = 1403636579763555584
    rows = "#timestamp [ns],filename\r\n"
    for stamp in (first, first + 50_000_000):
        rows += f"{stamp},{stamp}.png\r\n"
        image = np.full((480, 752), stamp % 251, np.uint8)
        cv2.imwrite(str(root / "cam0" / "data" / f"{stamp}.png"), image)
    (root / "cam0" / "data.csv").write_text(rows)
    (root / "imu0" / "sensor.yaml").write_text(
        "#Default imu sensor yaml file\nsensor_type: imu\ncomment: VI-Sensor IMU (ADIS16448)\n\n"
        "# Sensor extrinsics wrt. the body-frame.\nT_BS:\n  cols: 4\n  rows: 4\n"
        "  data: [1.0, 0.0, 0.0, 0.0,\n         0.0, 1.0, 0.0, 0.0,\n"
        "         0.0, 0.0, 1.0, 0.0,\n         0.0, 0.0, 0.0, 1.0]\nrate_hz: 200\n\n"
        "# inertial sensor noise model parameters (static)\n"
        "gyroscope_noise_density: 1.6968e-04     # [ rad / s / sqrt(Hz) ]\n"
        "gyroscope_random_walk: 1.9393e-05       # [ rad / s^2 / sqrt(Hz) ]\n"
        "accelerometer_noise_density: 2.0000e-3  # [ m / s^2 / sqrt(Hz) ]\n"
        "accelerometer_random_walk: 3.0000e-3    # [ m / s^3 / sqrt(Hz) ]\n"
    )
    (root / "imu0" / "data.csv").write_text(
        "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
        "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n"
        "1403636579758555392,-0.099134701513277898,0.14730578886832138,0.02722713633111154,"
        "8.1476917083333333,-0.37592158333333331,-2.4026292499999999\n"
        "1403636579763555584,-0.099134701513277898,0.14032447186034408,0.029321531433504733,"
        "8.033280791666667,-0.40861041666666664,-2.4026292499999999\n"
    )
    (root / "state_groundtruth_estimate0" / "data.csv").write_text(
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], "
        "q_RS_z [], v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], "
        "b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], b_w_RS_S_z [rad s^-1], "
        "b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]\n"
        "1403636580838555648,4.688319,-1.786938,0.783338,0.534108,-0.153029,-0.827383,-0.082152,"
        "-0.027876,0.033207,0.800006,-0.003172,0.021267,0.078502,-0.025266,0.136696,0.075593\n"
    )
    return root.parent


def tum_as_published(folder: Path) -> Path:
    """Return a data set as cvg.cit.tum.de has it: depth and colour at times of their own."""
    root = folder / "rgbd_dataset_freiburg1_xyz"
    for kind in ("rgb", "depth"):
        (root / kind).mkdir(parents=True)
    head = "# {}\n# file: 'rgbd_dataset_freiburg1_xyz.bag'\n# timestamp filename\n"
    colours = ["1305031102.175304", "1305031102.211214", "1305031102.243211"]
    colours += ["1305031102.850000"]  # 50 ms before the last depth image
    depths = ["1305031102.160407", "1305031102.226738", "1305031102.262886", "1305031102.900000"]
    image = np.zeros((480, 640, 3), np.uint8)
    image[:] = (10, 20, 30)  # blue, green, red
    steps = np.full((480, 640), 5000, np.uint16)
    steps[0, 0] = 0
    for name in colours:
        cv2.imwrite(str(root / "rgb" / f"{name}.png"), image)
    for name in depths:
        cv2.imwrite(str(root / "depth" / f"{name}.png"), steps)
    for kind, title, names in (
        ("rgb", "color images", colours),
        ("depth", "depth maps", depths),
    ):
        rows = "".join(f"{name} {kind}/{name}.png\n" for name in names)
        (root / f"{kind}.txt").write_text(head.format(title) + rows)
    (root / "groundtruth.txt").write_text(
        "# ground truth trajectory\n# file: 'rgbd_dataset_freiburg1_xyz.bag'\n"
        "# timestamp tx ty tz qx qy qz qw\n"
        "1305031098.6659 1.3563 0.6305 1.6380 0.6132 0.5962 -0.3311 -0.3986\n"
        "1305031102.1800 1.3405 0.6266 1.6575 0.6574 0.6126 -0.2949 -0.3248\n"
    )
    return root


SETS = {
    "recording": recording,
    "torn": torn,
    "sqlite": bag,
    "mcap": mcap_bag,
    "compressed": compressed_bag,
    "euroc": euroc,
    "tum_rgbd": tum_rgbd,
    "euroc as published": euroc_as_published,
    "tum as published": tum_as_published,
}


def reader(path: Path, **settings: object) -> Reader:
    if path.name.startswith("rgbd_dataset_freiburg"):  # whose authors recommend these
        settings.setdefault("camera", {"fx": 525.0, "fy": 525.0, "cx": 319.5, "cy": 239.5})
    config = msgspec.convert({"file": str(path), **settings}, ReplayConfig)
    return open_reader(config, "drone")
