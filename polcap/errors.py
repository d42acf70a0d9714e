"""Errors of polcap, and their exit codes.

::

    PolcapError                    base of all errors
    ├── InputError          exit 2   the user's input is wrong
    │   ├── SettingError             a setting, flag or TOML key
    │   ├── CaptureError             the folder, its layout, missing or swapped shots
    │   ├── DecodeError              one RAW or image file
    │   ├── ChartError               the ColorChecker
    │   ├── AlignmentError           registration of a shot
    │   ├── ObjectError              the object's mask
    │   ├── ModelError               the ONNX file or its provider
    │   └── StorageError             a full, read-only or locked disk
    ├── GateError           exit 3   a quality gate failed; the asset was written
    └── HardwareError       exit 4   camera, rotator, port

A message is one line: the thing, its value, the limit and the remedy.
"""

from collections.abc import Iterator
from contextlib import contextmanager


class PolcapError(Exception):
    """An error with a message of one line: the thing, its value, the limit and the remedy."""

    exit_code = 1


class InputError(PolcapError):
    exit_code = 2


class SettingError(InputError): ...


class CaptureError(InputError): ...


class DecodeError(InputError): ...


class ChartError(InputError):
    def __init__(self, message: str, reason: str = "") -> None:
        super().__init__(message)
        self.reason = reason or message  # why no chart can be used, without its place and the remedy


class AlignmentError(InputError): ...


class ObjectError(InputError): ...


class ModelError(InputError): ...


class StorageError(InputError): ...


class GateError(PolcapError):
    exit_code = 3


class HardwareError(PolcapError):
    exit_code = 4


def one_line(error: BaseException) -> str:
    """The message of any error on one line."""
    return " ".join(str(error).split())


@contextmanager
def package_for(purpose: str, package: str, extra: str, instead: str = "") -> Iterator[None]:
    """Context manager for an import of `polcap[extra]`: a SettingError names the missing `package`, then `instead`."""
    try:
        yield
    except ModuleNotFoundError:
        raise SettingError(f"{purpose} needs {package}; pip install 'polcap[{extra}]'{instead}") from None
