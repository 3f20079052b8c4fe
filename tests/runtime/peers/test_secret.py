"""Who may take part: those who know a secret, which others cannot read."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from runtime.config.model import Config, NetworkConfig, to_builtins
from runtime.config.reading import parse
from runtime.errors import PeerError
from runtime.peers.authentication import secret_of

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
    found: list[bytes] = []
    threads = [threading.Thread(target=lambda: found.append(secret_of(""))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(found)) == 1
    assert len(found) == 8
    assert len(found[0]) == 64
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
        node = {"name": "a", "type": "tests.runtime.peers.samples:Asker"}
        return parse({"network": {"secret": secret}, "nodes": [node]}, "test.toml")

    assert LONG not in str(to_builtins(settings(LONG)))
    assert to_builtins(settings("env:OURS"))["network"]["secret"] == "env:OURS"
    assert NetworkConfig().secret == ""
