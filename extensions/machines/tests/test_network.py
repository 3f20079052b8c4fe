"""Two machines, as two network namespaces with a wire between them that can be made worse.

Needs root and iproute2; where these are missing, the tests are skipped and say so.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from extensions.machines.tests.test_losses import Rig, wait_for

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        os.geteuid() != 0 or not (shutil.which("ip") and shutil.which("tc")),
        reason="network namespaces need root, ip and tc",
    ),
]

MEET = "10.77.7.1"


def sh(command: str) -> None:
    subprocess.run(command.split(), check=True, capture_output=True)


@pytest.fixture
def wire() -> Iterator[tuple[str, str]]:
    """Make two namespaces, and return what to put before a command to run it in them."""
    one, two = (f"visnav{os.getpid()}{end}" for end in "ab")
    try:
        for name in (one, two):
            sh(f"ip netns add {name}")
        sh(f"ip link add {one}v netns {one} type veth peer name {two}v netns {two}")
        for name, address in ((one, MEET), (two, "10.77.7.2")):
            sh(f"ip -n {name} addr add {address}/24 dev {name}v")
            sh(f"ip -n {name} link set {name}v up")
            sh(f"ip -n {name} link set lo up")
    except subprocess.CalledProcessError as error:
        pytest.skip(f"no network namespaces here: {error.stderr}")
    yield one, two
    for name in (one, two):
        sh(f"ip netns del {name}")


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path)
    yield rig
    for process in rig.started:
        process.kill()
        process.communicate()


def spoil(name: str, how: str) -> None:
    """Make one end of the wire worse, in netem's words."""
    try:
        sh(f"tc -n {name} qdisc add dev {name}v root netem {how}")
    except subprocess.CalledProcessError as error:
        pytest.skip(f"this kernel has no netem: {error.stderr}")


def test_a_slow_wire_that_loses_packets_changes_nothing_but_the_time(
    rig: Rig, wire: tuple[str, str]
) -> None:
    one, two = wire
    rig.write(clock="lockstep", on_error="stop", duration="2s", meet=f"tcp/{MEET}:7450")
    alone = rig.start("asker,one,other", "alone")
    alone.communicate(timeout=30)
    spoil(one, "delay 2ms 1ms loss 2%")
    spoil(two, "delay 2ms 1ms loss 2%")
    there = rig.start("one,other", "there", f"ip netns exec {two}")
    here = rig.start("asker", "here", f"ip netns exec {one}")
    for process in (there, here):
        said, _ = process.communicate(timeout=50)
        assert process.returncode == 0, said
    assert rig.summary("here").digest == rig.summary("alone").digest
    assert rig.summary("there").digest == rig.summary("alone").digest


@pytest.mark.parametrize("clock", ["lockstep", "real"])
def test_a_cut_wire_is_noticed_and_the_run_goes_on_when_it_is_mended(
    rig: Rig, wire: tuple[str, str], clock: str
) -> None:
    one, two = wire
    rig.write(clock=clock, on_error="restart", duration="10s", meet=f"tcp/{MEET}:7450")
    rig.file.write_text(rig.file.read_text().replace('Asker"', 'Asker"\non_error = "restart"'))
    there = rig.start("one,other", "there", f"ip netns exec {two}")
    here = rig.start("asker", "here", f"ip netns exec {one}")
    wait_for(here, "Answered")
    sh(f"ip -n {one} link set {one}v down")
    wait_for(here, "one, other: their process is gone")
    wait_for(there, "asker: their process is gone")
    sh(f"ip -n {one} link set {one}v up")
    wait_for(here, "one, other: found again")
    wait_for(here, "Answered")
    for process in (here, there):
        said, _ = process.communicate(timeout=50)
        assert process.returncode == 0, said
    assert rig.summary("here").reason == "duration"
