"""TLS and access control by a Zenoh file: who may not, is not heard."""

from __future__ import annotations

import contextlib
import json
import queue
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from nodes.ros2.bridge.keys import NodeName, data_key
from nodes.ros2.bridge.session import Session
from nodes.ros2.messages.topics import Qos, Topic
from tests.nodes.ros2.bridge.network import free_port

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not shutil.which("openssl"), reason="makes certificates with openssl"),
]

NODE = NodeName(name="visnav")
EMPTY = "std_msgs/msg/Empty"
STEER = Topic(name="/cmd_vel", type=EMPTY, hash="RIHS01_0")
ODOM = Topic(name="/odom", type=EMPTY, hash="RIHS01_0")
STATIC = Topic(
    name="/tf_static", type=EMPTY, hash="RIHS01_0", qos=Qos(transient_local=True, depth=1)
)

FILE = """{
  listen: { endpoints: ["tls/localhost:PORT"] },
  transport: { link: { tls: {
    root_ca_certificate: "FOLDER/ca.pem",
    listen_certificate: "FOLDER/drone.pem", listen_private_key: "FOLDER/drone.key",
    enable_mtls: true,  // others need a certificate, too
  } } },
  access_control: {
    enabled: true,
    default_permission: "deny",
    rules: [
      { id: "show", permission: "allow", flows: ["egress"],
        key_exprs: ["**", "@ros2_lv/**", "**/@adv/**"],
        messages: ["put", "reply", "liveliness_token", "declare_queryable"] },
      { id: "look", permission: "allow", flows: ["ingress"],
        key_exprs: ["**", "@ros2_lv/**", "**/@adv/**"],
        messages: ["declare_subscriber", "query", "liveliness_token", "liveliness_query",
                   "declare_liveliness_subscriber"] },
      { id: "hear", permission: "allow", flows: ["egress"],
        key_exprs: ["0/cmd_vel/**"], messages: ["declare_subscriber"] },
      { id: "steer", permission: "allow", flows: ["ingress"],
        key_exprs: ["0/cmd_vel/**"], messages: ["put"] },
    ],
    subjects: [{ id: "anybody" }, { id: "pilot", cert_common_names: ["pilot"] }],
    policies: [
      { rules: ["show", "look", "hear"], subjects: ["anybody"] },
      { rules: ["steer"], subjects: ["pilot"] },
    ],
  },
}"""


def certificates(folder: Path, *names: str) -> None:
    """Make an authority, and certificates of it."""

    def openssl(*words: str) -> None:
        subprocess.run(["openssl", *words], cwd=folder, check=True, capture_output=True)

    key = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-keyout"]
    openssl("req", "-x509", *key, "ca.key", "-out", "ca.pem", "-days", "2", "-subj", "/CN=ca")
    (folder / "names").write_text("subjectAltName=DNS:localhost\n")
    for name in names:
        openssl("req", *key, f"{name}.key", "-out", f"{name}.csr", "-subj", f"/CN={name}")
        signing = ["-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial", "-extfile", "names"]
        openssl("x509", "-req", "-in", f"{name}.csr", *signing, "-out", f"{name}.pem")


@contextlib.contextmanager
def client(folder: Path, port: int, name: str) -> Iterator[zenoh.Session]:
    configuration = zenoh.Config()
    tls = "transport/link/tls"
    for key, value in {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "listen/endpoints": [],
        "connect/endpoints": [f"tls/localhost:{port}"],
        f"{tls}/root_ca_certificate": str(folder / "ca.pem"),
        **(
            {
                f"{tls}/enable_mtls": True,
                f"{tls}/connect_certificate": str(folder / f"{name}.pem"),
                f"{tls}/connect_private_key": str(folder / f"{name}.key"),
            }
            if name
            else {}
        ),
    }.items():
        configuration.insert_json5(key, json.dumps(value))
    with zenoh.open(configuration) as session:
        yield session


def test_only_who_may_is_heard(tmp_path: Path) -> None:
    """A guest sees all and steers nothing; who has no certificate sees nothing."""
    certificates(tmp_path, "drone", "pilot", "guest")
    port, file = free_port(), tmp_path / "zenoh.json5"
    file.write_text(FILE.replace("PORT", str(port)).replace("FOLDER", str(tmp_path)))
    session = Session(NODE, connect=(), file=str(file))
    heard: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    try:
        session.subscribe(STEER, lambda message: heard.put(message.read()))
        odom, static = session.publisher(ODOM), session.publisher(STATIC)
        static.put(bytearray(b"kept"))
        for name in ("guest", "pilot"):
            seen: queue.SimpleQueue[Any] = queue.SimpleQueue()
            with client(tmp_path, port, name) as other:
                publisher = other.declare_publisher(
                    data_key(0, STEER), congestion_control=zenoh.CongestionControl.BLOCK
                )
                other.liveliness().declare_subscriber("@ros2_lv/**", seen.put, history=True)
                tokens = {str(seen.get(timeout=10).key_expr).split("/")[5] for _ in range(4)}
                assert tokens == {"NN", "MP", "MS"}
                history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
                _late = zenoh.ext.declare_advanced_subscriber(
                    other, data_key(0, STATIC), seen.put, history=history
                )
                assert seen.get(timeout=10).payload.to_bytes() == b"kept"
                with other.declare_subscriber(data_key(0, ODOM), seen.put):
                    while seen.empty():
                        odom.put(bytearray(b"here"))
                    assert seen.get().payload.to_bytes() == b"here"
                publisher.put(name.encode())
                if name == "pilot":
                    assert heard.get(timeout=10) == b"pilot"
        with client(tmp_path, port, "") as nobody:
            assert nobody.info.peers_zid() == []
        assert heard.empty()
    finally:
        session.close()
