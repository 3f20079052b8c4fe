"""Who may take part: those who know a secret, which others cannot read.

What they seal is heard once, in order, and as it was; everything else is not.
"""

from __future__ import annotations

import threading
from pathlib import Path
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.config.model import Config, NetworkConfig, to_builtins
from runtime.config.reading import parse
from runtime.errors import PeerError, WireError
from visnav_machines import session
from visnav_machines.session import ForgedError, Seal, Sealing, derive, hello_seal, secret_of

A, B = ("a", b"1" * 16), ("b", b"2" * 16)
MESSAGES = st.lists(st.tuples(st.binary(max_size=40), st.binary(max_size=40)), max_size=6)


def ends(key: bytes = b"k" * 32) -> tuple[Sealing, Sealing]:
    return Sealing(key, A, B), Sealing(key, B, A)


@given(MESSAGES)
def test_messages_arrive_as_they_were(messages: list[tuple[bytes, bytes]]) -> None:
    here, there = ends()
    for message, payload in messages:
        assert there.open(here.seal(message, payload), payload) == message
        assert here.open(there.seal(message, payload), payload) == message
    assert here.tag == there.tag


@given(st.binary(max_size=40), st.binary(max_size=9000), st.integers(0, 1 << 32))
def test_whatever_is_changed_is_noticed(message: bytes, payload: bytes, seed: int) -> None:
    here, there = ends()
    sealed = here.seal(message, payload)
    place = Random(seed).randrange(8 * (len(sealed) + len(payload)))
    both = bytearray(sealed + payload)
    both[place // 8] ^= 1 << place % 8
    with pytest.raises(ForgedError):
        there.open(bytes(both[: len(sealed)]), bytes(both[len(sealed) :]))
    assert there.open(sealed, payload) == message


@pytest.mark.slow
@given(st.binary(max_size=60))
def test_what_was_never_sealed_is_not_heard(data: bytes) -> None:
    with pytest.raises(ForgedError):
        ends()[1].open(data, b"")


def test_neither_ours_nor_anothers_nor_an_old_one_is_taken_for_theirs() -> None:
    here, there = ends()
    first = here.seal(b"x", b"")
    for wrong in (ends(b"other" * 8)[0].seal(b"x", b""), there.seal(b"x", b"")):
        with pytest.raises(ForgedError):
            there.open(wrong, b"")
    assert there.open(first, b"") == b"x"
    with pytest.raises(ForgedError, match="again"):
        there.open(first, b"")
    here.seal(b"lost", b"")
    with pytest.raises(WireError, match="lost") as raised:
        there.open(here.seal(b"y", b""), b"")
    assert not isinstance(raised.value, ForgedError)


def test_a_hello_holds_for_one_pair_and_one_run_and_one_version(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    key = derive(b"secret", "run", "tour")
    hello = hello_seal(key, "a", "b").seal_message(0, b"hello")
    assert hello_seal(key, "a", "b").unseal(0, hello) == b"hello"
    for other in (
        hello_seal(key, "b", "a"),
        hello_seal(key, "a", "c"),
        hello_seal(derive(b"secret", "run", "other"), "a", "b"),
        hello_seal(derive(b"Secret", "run", "tour"), "a", "b"),
    ):
        with pytest.raises(ForgedError):
            other.unseal(0, hello)
    monkeypatch.setattr(session, "VERSION", 99)
    with pytest.raises(PeerError, match="version 99"):
        hello_seal(key, "a", "b").unseal(0, hello)


def test_parts_of_a_key_do_not_run_together() -> None:
    assert derive(b"s", "ab", "c") != derive(b"s", "a", "bc")
    assert Seal(derive(b"s", "a")).seal_message(1, b"ab", b"c") != Seal(
        derive(b"s", "a")
    ).seal_message(1, b"a", b"bc")


LONG = "correct horse battery"


def test_it_is_what_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "secret"
    file.write_text(f"{LONG}\n")
    file.chmod(0o600)
    monkeypatch.setenv("OUR_SECRET", LONG)
    for setting in (LONG, "env:OUR_SECRET", f"file:{file}"):
        assert secret_of(setting) == LONG.encode()


@pytest.mark.parametrize("setting", ["short", "env:NOT_THERE", "file:/not/there"])
def test_what_is_none_is_named(setting: str) -> None:
    with pytest.raises(PeerError, match=r"network.secret: expected .* found"):
        secret_of(setting)


def test_a_file_that_others_may_read_is_none(tmp_path: Path) -> None:
    file = tmp_path / "secret"
    file.write_text(LONG)
    file.chmod(0o644)
    with pytest.raises(PeerError, match="only its user may read, found mode 644"):
        secret_of(f"file:{file}")


def test_of_one_machine_it_is_a_private_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same for all, also if they begin at once."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    secrets: list[bytes] = []
    threads = [threading.Thread(target=lambda: secrets.append(secret_of(""))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(secrets)) == 1
    assert len(secrets) == 8
    assert len(secrets[0]) == 64
    (file,) = (tmp_path / "visnav").iterdir()
    assert file.stat().st_mode & 0o777 == 0o600


def test_without_a_folder_for_it_one_is_told_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "file"))
    with pytest.raises(PeerError, match=r"network.secret: .*name a secret"):
        secret_of("")


def test_it_is_not_written_with_the_results() -> None:
    def settings(secret: str) -> Config:
        node = {"name": "a", "type": "extensions.machines.tests.samples:Asker"}
        return parse({"network": {"secret": secret}, "nodes": [node]}, "test.toml")

    assert LONG not in str(to_builtins(settings(LONG)))
    assert to_builtins(settings("env:OURS"))["network"]["secret"] == "env:OURS"
    assert NetworkConfig().secret == ""
