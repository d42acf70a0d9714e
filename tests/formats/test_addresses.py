"""Addresses are percent-encoded as RFC 3986 demands, and lead where the text leads."""

import re
from urllib.parse import unquote, unquote_to_bytes

import pytest

from polcap.formats import addresses

VALID = re.compile(r"https?://[A-Za-z0-9._~%!$&'()*+,;=:@\[\]-]*(/([A-Za-z0-9._~!$&'()*+,;=:@-]|%[0-9A-Fa-f]{2})*)*")


@pytest.mark.parametrize(
    "text",
    [
        "https://example.org/my files", "https://example.org/pot #3", "https://example.org/50 %/vase?",
        "https://museum.example/Gefäße/Öl", 'http://localhost:8000/a"b<c>`{d}|^\\e', "http://[::1]:8000/x[1]",
        "https://müller.example/", "https://example.org", "https://user@example.org/a/b+c;d=e",
    ],
)  # fmt: skip
def test_a_web_address_is_valid_and_encoded_once(text: str) -> None:
    encoded = addresses.of_web(text)
    assert VALID.fullmatch(encoded), encoded
    assert unquote(encoded) == text
    assert addresses.of_web(encoded) == encoded


def test_the_address_of_a_file_may_hold_any_bytes() -> None:
    assert addresses.of_file("pot #3/50%/a?.glb") == "pot%20%233/50%25/a%3F.glb"
    assert unquote_to_bytes(addresses.of_file("caf\udce9.glb")) == b"caf\xe9.glb"
