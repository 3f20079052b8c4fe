"""Requests by a name that a page gave to this machine are refused, and so are two hosts."""

from __future__ import annotations

import pytest

from runtime.http_gate import HttpError, check_headers


@pytest.mark.parametrize("host", ["localhost:8765", "10.0.0.7:8765", "[::1]:8765", "127.0.0.1"])
def test_addresses_and_names_of_this_machine_are_taken(host: str) -> None:
    assert check_headers([("Host", host), ("X", " 1 ")], ("host",)) == {"host": host, "x": "1"}
    assert check_headers([("Host", "here:80")], ("host",), ("here",)) == {"host": "here:80"}


@pytest.mark.parametrize("hosts", [["evil.example:8765"], ["localhost.evil.example"], [""], []])
def test_other_names_are_refused(hosts: list[str]) -> None:
    with pytest.raises(HttpError, match="expected a request to an address or localhost") as refused:
        check_headers([("Host", host) for host in hosts], ("host",))
    assert refused.value.args[0] == 403


@pytest.mark.parametrize("second", ["evil.example", "localhost"])
def test_of_two_headers_neither_counts_where_one_must(second: str) -> None:
    with pytest.raises(HttpError, match="expected one header host, found two") as refused:
        check_headers([("Host", "localhost"), ("host ", second)], ("host",))
    assert refused.value.args[0] == 400
    headers = [("Host", "localhost"), ("Accept", "a"), ("Accept", "b")]
    assert check_headers(headers, ("host",))["accept"] == "b"
