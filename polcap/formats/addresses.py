"""Percent-encodes the addresses of files and web pages (RFC 3986, §2 and §3)."""

import os
import re
from urllib.parse import quote, urlsplit

_PATH = "/:@!$&'()*+,;=~%"  # characters of a path that stay, with those of an address that is encoded already
_STRAY = re.compile(r"%(?![0-9A-Fa-f]{2})")  # a % that begins no encoded character


def of_file(relative: str) -> str:
    """Address of a file, relative to the page that links to it; the names in its path may hold any bytes."""
    try:
        return quote(os.fsencode(relative))
    except UnicodeEncodeError:  # of a damaged record: no file has this name
        return quote(relative.encode("utf-8", "backslashreplace"))


def of_web(address: str) -> str:
    """A web address without characters that addresses cannot hold; encoded ones stay, `#` and `?` are part of names."""
    host = urlsplit(address.replace("#", "/").replace("?", "/")).netloc
    start, _, path = address.partition(host)
    return quote(start + host, safe=_PATH + "[]") + quote(_STRAY.sub("%25", path), safe=_PATH)
