"""Every error polcap raises on purpose, and the exit code it ends with.

::

    PolcapError                    never raised itself
    ├── InputError          exit 2   what the user gave is at fault
    │   ├── SettingError             a setting, flag or TOML key
    │   ├── CaptureError             the folder, its layout, a missing or mixed-up shot
    │   ├── DecodeError              one RAW or image file
    │   ├── ChartError               the ColorChecker
    │   ├── AlignmentError           a shot that cannot be registered
    │   ├── ObjectError              the object's mask
    │   ├── ModelError               the ONNX file or its provider
    │   └── StorageError             disk full, read-only, locked
    ├── GateError           exit 3   the asset was written, but a quality gate failed
    └── HardwareError       exit 4   camera, rotator, port

A message is one line: the thing, the value, the limit, the remedy.
"""


class PolcapError(Exception):
    """What polcap tells in one line: the thing, the value, the limit, the remedy."""

    exit_code = 1


class InputError(PolcapError):
    exit_code = 2


class SettingError(InputError): ...


class CaptureError(InputError): ...


class DecodeError(InputError): ...


class ChartError(InputError): ...


class AlignmentError(InputError): ...


class ObjectError(InputError): ...


class ModelError(InputError): ...


class StorageError(InputError): ...


class GateError(PolcapError):
    exit_code = 3


class HardwareError(PolcapError):
    exit_code = 4
