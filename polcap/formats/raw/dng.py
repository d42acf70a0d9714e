"""The writer of DNGs under the name that users' scripts know."""

from polcap.formats.dng_writer import write

__all__ = ["write"]
