"""Detects the kind of a file (RAW, picture, other) from its content, not its name; parses the directories of a TIFF.

All of it runs in the child process of `sandbox`.
"""

import struct
from collections import deque
from collections.abc import Iterator
from mmap import ACCESS_READ, mmap
from typing import BinaryIO, Literal, NamedTuple

Kind = Literal["raw", "photo", "other", "unknown"]

SUBTYPE, WIDTH, LENGTH, BITS, COMPRESSION, PHOTOMETRIC, MAKE = 254, 256, 257, 258, 259, 262, 271  # tags
STRIP_OFFSETS, SAMPLES, STRIP_BYTES, TILE_OFFSETS, TILE_BYTES, SUB_IFDS = 273, 277, 279, 324, 325, 330
TRANSFER_FUNCTION, SAMPLE_FORMAT, CFA_REPEAT = 301, 339, 33421
DNG_VERSION, CFA_LAYOUT, ORIGINAL_RAW_NAME, ACTIVE_AREA = 50706, 50711, 50827, 50829
BLACK_REPEAT, BLACK, BLACK_BY_COLUMN, BLACK_BY_ROW = 50713, 50714, 50715, 50716
OPCODE_LISTS, GAIN_TABLES = (51008, 51009, 51022), (52525, 52544)  # DNG; ProfileGainTableMap, its second form
CFA, LINEAR_RAW = 32803, 34892  # values of PHOTOMETRIC

JPEG, PNG, EXR = b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"\x76\x2f\x31\x01"  # first bytes
TIFF = (b"II*\0", b"MM\0*")
_RAW_SIGNATURES = (  # offset, bytes, suffix
    (0, b"FUJIFILMCCD-RAW", ".raf"), (0, b"\0MRM", ".mrw"), (0, b"FOVb", ".x3f"), (0, b"IIU\0", ".rw2"),
    (0, b"IIRO", ".orf"), (0, b"IIRS", ".orf"), (0, b"MMOR", ".orf"), (4, b"ftypcrx ", ".cr3"),
    (6, b"HEAPCCDR", ".crw"),
)  # fmt: skip
# of TIFFs by Sony, Samsung, Kodak, Panasonic, Nikon, Kodak, Pentax
_RAW_COMPRESSION = {32767, 32769, 32770, 32867, 34316, 34713, 65000, 65535}
_TAGS_READ = {
    SUBTYPE, WIDTH, LENGTH, BITS, COMPRESSION, PHOTOMETRIC, MAKE, DNG_VERSION, CFA_LAYOUT, SAMPLES,
    STRIP_OFFSETS, STRIP_BYTES, TILE_OFFSETS, TILE_BYTES, SUB_IFDS, TRANSFER_FUNCTION, ORIGINAL_RAW_NAME,
    SAMPLE_FORMAT, CFA_REPEAT, ACTIVE_AREA, BLACK_REPEAT, BLACK, BLACK_BY_COLUMN, BLACK_BY_ROW, *OPCODE_LISTS,
}  # fmt: skip
_FORMS = {1: "B", 2: "B", 3: "H", 4: "I", 5: "II", 7: "B", 10: "ii", 13: "I"}  # of values; a text is its bytes
MAX_DIRECTORIES, _MAX_VALUES = 64, 1 << 18  # per file: stops at a loop or a forged count
_SIDECARS = {".pdf", ".zip", ".txt"}  # binary, or text in UTF-16; `foreign_files` has those of photographs
_TEXT_BYTES = 1 << 16  # some makers put lines of text in front of their pixels

Directory = dict[int, tuple[float, ...]]


class TiffStructure(NamedTuple):
    """The image directories of a TIFF file: the first, its siblings and their children."""

    directories: tuple[Directory, ...]
    size: int  # bytes of the file

    @property
    def dng(self) -> bool:
        """Whether a directory of the TIFF has the DNG version tag."""
        return any(DNG_VERSION in directory for directory in self.directories)

    @property
    def truncated(self) -> bool:
        """Whether an image strip or tile extends beyond the end of the file, so that the file is cut short."""
        return any(a + b > self.size for directory in self.directories for a, b in strips(directory))


def strips(directory: Directory) -> list[tuple[int, int]]:
    """Byte offset and length of each image strip or tile of a TIFF directory."""
    return [
        (int(start), int(count))
        for starts, counts in ((STRIP_OFFSETS, STRIP_BYTES), (TILE_OFFSETS, TILE_BYTES))
        for start, count in zip(directory.get(starts, ()), directory.get(counts, ()))
    ]


def original_name(structure: TiffStructure) -> str:
    """Name of the RAW from which a DNG was converted; empty if it states none."""
    names = (stored_bytes(one, ORIGINAL_RAW_NAME) for one in structure.directories if ORIGINAL_RAW_NAME in one)
    return next(names, b"").rstrip(b"\0").decode(errors="replace")


def stored_bytes(directory: Directory, tag: int) -> bytes:
    """The bytes of a tag in a TIFF directory; none if the tag is absent."""
    return bytes(int(value) & 0xFF for value in directory.get(tag, ()))


def first(directory: Directory, tag: int, default: int = 0) -> int:
    """First value of a tag in a TIFF directory; `default` if the tag is absent, empty or not a number."""
    return int(next(iter(directory.get(tag, ())), default))


def is_sensor(directory: Directory) -> bool:
    """Whether a TIFF directory holds a sensor's counts: a mosaic, or linear channels."""
    return first(directory, PHOTOMETRIC) in (CFA, LINEAR_RAW)


def kind(file: BinaryIO, suffix: str) -> Kind:
    """Kind of a file by its first bytes: RAW, finished picture, other known file, or unknown."""
    head = file.read(512)
    if head.startswith((JPEG, PNG, EXR)):
        return "photo"
    is_raw_tiff = head[:2] in (b"II", b"MM") and (head[8:10] == b"CR" or head[8:12] in (b"IIII", b"MMMM"))  # CR2, IIQ
    if is_raw_tiff or raw_suffix(head) is not None:
        return "raw"
    if head.startswith(TIFF):
        return "raw" if _is_raw(structure(_mapped(file))) else "photo"
    # HEIC, AVIF or WebP next to a RAW; films; sounds
    is_other = head[4:8] == b"ftyp" or head[:4] == b"RIFF" or suffix.lower() in _SIDECARS
    return "other" if is_other or _is_text(file) else "unknown"


def _mapped(file: BinaryIO) -> bytes | mmap:
    """Bytes of a file as a memory map, so that only the pages in use are read; on a drive without maps, all bytes."""
    try:
        return mmap(file.fileno(), 0, access=ACCESS_READ)
    except OSError:
        file.seek(0)
        return file.read()


def _is_text(file: BinaryIO) -> bool:
    """Whether a file is text: its beginning, middle and end have no control characters 0 to 8 and 14 to 26."""
    size = file.seek(0, 2)
    pieces = []
    for at in (0, size // 2, size - _TEXT_BYTES):
        file.seek(max(at, 0))
        pieces.append(file.read(_TEXT_BYTES))
    return bool(pieces[0]) and not any(byte < 9 or 13 < byte < 27 for byte in set(b"".join(pieces)))


def raw_suffix(head: bytes) -> str | None:
    """File name suffix of a RAW file that is not an ordinary TIFF, by its first bytes; None for other files."""
    return next((suffix for at, signature, suffix in _RAW_SIGNATURES if head.startswith(signature, at)), None)


def _is_raw(tiff: TiffStructure) -> bool:
    """Whether a TIFF structure is that of a RAW file."""
    if tiff.dng or any(
        is_sensor(directory) or first(directory, COMPRESSION) in _RAW_COMPRESSION for directory in tiff.directories
    ):
        return True
    main = tiff.directories[0] if tiff.directories else {}
    return MAKE in main and SUB_IFDS in main and main.get(SUBTYPE) == (1,)  # a preview in front of sensor data


def png_chunks(data: bytes) -> dict[bytes, bytes]:
    """Chunks of a PNG in front of its pixels, by type; none if the bytes are not a PNG."""
    chunks: dict[bytes, bytes] = {}
    position = len(PNG) if data.startswith(PNG) else len(data)
    while position + 8 <= len(data) and data[position + 4 : position + 8] != b"IDAT":
        (length,) = struct.unpack_from(">I", data, position)
        chunks.setdefault(data[position + 4 : position + 8], data[position + 8 : position + 8 + length])
        position += 12 + length
    return chunks


def structure(data: bytes | mmap) -> TiffStructure:
    """Parse the image directories of a TIFF, as far as they are readable; none if the bytes are not a TIFF."""
    directories: list[Directory] = []
    if data[:4] in TIFF and len(data) >= 8:
        order = "<" if data[:2] == b"II" else ">"
        pending = deque(struct.unpack_from(order + "I", data, 4))
        seen: set[int] = set()
        values_left = _MAX_VALUES
        while pending and len(directories) < MAX_DIRECTORIES and values_left > 0:
            offset = pending.popleft()
            if offset in seen or not 8 <= offset <= len(data) - 2:
                continue
            seen.add(offset)
            (count,) = struct.unpack_from(order + "H", data, offset)
            end = offset + 2 + 12 * count
            directory = dict(_entries(data, order, range(offset + 2, min(end, len(data) - 11), 12), values_left))
            values_left -= sum(map(len, directory.values()))
            directories.append(directory)
            following = struct.unpack_from(order + "I", data, end) if end + 4 <= len(data) else ()
            pending.extend((*map(int, directory.get(SUB_IFDS, ())), *following))
    return TiffStructure(tuple(directories), len(data))


def _entries(data: bytes | mmap, order: str, places: range, most: int) -> Iterator[tuple[int, tuple[float, ...]]]:
    """Tag and numbers of the known TIFF directory entries at the byte offsets `places`.

    At most `most` values are read in all; an entry with more values is skipped. Values of other types become ().
    """
    for at in places:
        tag, form, count = struct.unpack_from(order + "HHI", data, at)
        if tag in GAIN_TABLES or (tag in _TAGS_READ and form not in _FORMS):  # only its presence counts
            yield tag, ()
            continue
        if tag not in _TAGS_READ or count > most:
            continue
        numbers = _FORMS[form]
        code = f"{order}{len(numbers) * count}{numbers[0]}"
        length = struct.calcsize(code)
        start = at + 8 if length <= 4 else struct.unpack_from(order + "I", data, at + 8)[0]
        if start + length <= len(data):
            most -= count
            values = struct.unpack_from(code, data, start)
            if len(numbers) == 2:  # numerators and denominators
                values = tuple(a / b for a, b in zip(values[::2], values[1::2])) if all(values[1::2]) else ()
            yield tag, values
