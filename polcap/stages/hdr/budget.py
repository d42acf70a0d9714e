"""In: the memory that this process may still take. Out: how much of it the merge holds on to; the rest is made anew.

A limit on memory (`--memory`, `ulimit -d`) is planned by, not run into: frames are decoded again for every pass and
their planes made block by block, where there is no room to hold them. The pixels are the same.
"""

from dataclasses import dataclass

from polcap.errors import SettingError

_PLANES_BYTES = 400_000_000  # of a shot's signals; those of larger shots are made anew for every pass
_HELD_BYTES = 1_100_000_000  # of decoded frames; more are decoded again when they are needed again
_SAMPLE = 4  # bytes of a float32
_WORK = 60  # bytes per pixel of the grid: first estimate, registration, masks and blocks


@dataclass(frozen=True)
class Budget:
    """What the merge may hold on to, bytes."""

    planes: int = _PLANES_BYTES
    frames: int = _HELD_BYTES


def plan(shots: int, frames: int, pixels: int, frame_bytes: int) -> Budget:
    """What to hold of a capture.

    Parameters
    ----------
    shots
        How many.
    frames
        Of each shot.
    pixels
        Of the merged picture's grid.
    frame_bytes
        Of a decoded frame.

    Returns
    -------
    Budget
        The usual one where no limit stands.

    Raises
    ------
    SettingError
        Even without holding anything the merge needs more than may be taken.
    """
    taken, limit = memory()
    if limit is None:
        return Budget()
    stack = pixels * shots * (6 * _SAMPLE + 1)
    one_shot = frames * (frame_bytes + pixels) + pixels * _WORK
    left = limit - taken - stack - one_shot
    if left < 0:
        raise SettingError(
            f"--memory {limit / 1e9:.3g}: merging {shots} × {frames} frames of {pixels / 1e6:.3g} million pixels "
            f"needs {(limit - left) / 1e9:.2f} GB at least; raise it, or leave it out"
        )
    planes = 3 * _SAMPLE * pixels * frames
    kept = min(_PLANES_BYTES, left) if planes <= left else 0
    return Budget(kept, min(_HELD_BYTES, left - min(planes, kept)))


def memory() -> tuple[int, int | None]:
    """Bytes of private, writable memory that this process has taken and may take; None where nothing limits it."""
    try:
        import resource

        with open("/proc/self/statm", encoding="ascii") as file:
            taken = int(file.read().split()[5]) * resource.getpagesize()
    except (ImportError, OSError):  # the system has no such limit, or does not tell what is taken
        return 0, None
    limit = resource.getrlimit(resource.RLIMIT_DATA)[0]
    return taken, None if limit == resource.RLIM_INFINITY else limit
