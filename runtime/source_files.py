"""File names of sources: one for each, and back."""

from __future__ import annotations

import urllib.parse

_RESERVED = {"truth", "plan"}


def source_file(source: str) -> str:
    """Return the name of a source's files, without a suffix; no two sources have the same.

    ``/`` becomes ``+``. All but ASCII's letters and digits, ``-`` and ``_`` becomes ``~`` and two
    hexadecimal digits for each byte, and so does the first letter of a name that other files have.
    There is no dot in it: what follows one says which file of the source it is.
    """
    quoted = urllib.parse.quote(source, safe="/", errors="surrogatepass")
    if source in _RESERVED:
        quoted = f"%{ord(source[0]):02X}{source[1:]}"
    quoted = quoted.replace("~", "%7E").replace(".", "%2E")
    return quoted.replace("/", "+").replace("%", "~")


def source_of(name: str) -> str:
    """Return the source of a file name; the inverse of `source_file`."""
    quoted = name.replace("~", "%").replace("+", "/")
    return urllib.parse.unquote(quoted, errors="surrogatepass")
