"""In: sound bytes and a random source. Out: bytes that are nearly those: what a bad card, cable or attacker makes."""

from random import Random

_TOKENS = (
    b"nan", b"inf", b"-1", b"1e999", b"9" * 40, b"null", b"[[[[", b"{", b'"', b"\\", b"\n", b"\0", b"../", b"\x1b[2J",
    b"\xff", b"true", b"''", b"0x", b"=", b"\xed\xa0\x80", b"9" * 5000,
)  # fmt: skip
_EDGES = (0, 1, 0x7F, 0x80, 0xFF)
_ANY, _IN_PLACE = range(8), (0, 1, 2, 5)


def mutated(data: bytes, random: Random, most: int = 8, in_place: bool = False) -> bytes:
    """One to `most` changes: bytes flipped or set to an edge, parts cut, doubled, filled, swapped, tokens put in.

    `in_place` leaves out what moves the bytes behind it, so that offsets of a binary file lead where they led.
    """
    out = bytearray(data)
    for _ in range(random.randint(1, most)):
        if not out:
            return bytes(out)
        at = _somewhere(len(out), random)
        length = min(int(2 ** (12 * random.random())), len(out) - at)
        kind = random.choice(_IN_PLACE if in_place else _ANY)
        if kind == 0:
            out[at] ^= 1 << random.randrange(8)
        elif kind == 1:
            out[at] = random.choice(_EDGES)
        elif kind == 2:
            out[at : at + 4] = random.randbytes(4)
        elif kind == 3:
            del out[at : at + length]
        elif kind == 4:
            out[at:at] = out[at : at + length]
        elif kind == 5:
            out[at : at + length] = bytes([random.choice(_EDGES)]) * length
        elif kind == 6:
            out[at:at] = random.choice(_TOKENS)
        else:
            del out[at : None if random.random() < 0.3 else at + 1]
    return bytes(out)


def _somewhere(size: int, random: Random) -> int:
    """Mostly near the beginning, where headers lie."""
    reach = min(size, 600) if random.random() < 0.7 else size
    return random.randrange(reach)
