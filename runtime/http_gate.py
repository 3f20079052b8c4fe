"""What every server checks of a request that any page in a browser may have sent.

A page may give this machine's address a name of its own (DNS rebinding) and is then of the server's
origin: only addresses and this machine's own names are hosts. Tokens and origins are for the
servers to check.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Collection, Iterable


class HttpError(Exception):
    """Refusal of a request: a status, and a text."""


def check_headers(
    headers: Iterable[tuple[str, str]],
    once: Collection[str],
    names: Collection[str] = ("localhost",),
) -> dict[str, str]:
    """Return a request's headers by their names in small letters.

    Args:
        once: Headers to be given only once: with two, it would be unclear which of them counts.
        names: Names of this machine; any address is taken, too.

    Raises:
        HttpError: A header is given twice, or the host is neither a name nor an address.
    """
    fields: dict[str, str] = {}
    for spelt, value in headers:
        name = spelt.strip().lower()
        if name in fields and name in once:
            raise HttpError(400, f"expected one header {name}, found two")
        fields[name] = value.strip()
    address = fields.get("host", "")
    host = address[1:].partition("]")[0] if address[:1] == "[" else address.partition(":")[0]
    if host not in names:
        try:
            ipaddress.ip_address(host)
        except ValueError:
            raise HttpError(
                403, f"expected a request to an address or localhost, found {host!r:.80}"
            ) from None
    return fields
