"""Errors of the system while writing, as one line with reason and remedy."""

import errno
from pathlib import Path

from polcap.errors import StorageError

MISSING = (errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENODEV)  # of network drives
_REASONS = {
    errno.ENOSPC: "the disk is full; free some space",
    errno.EDQUOT: "the disk quota is used up; free some space",
    errno.EROFS: "the file system is read-only; choose another folder with -o",
    errno.EACCES: "permission denied; choose a folder that may be written with -o",
    errno.EPERM: "permission denied; choose a folder that may be written with -o",
    errno.EEXIST: "there is a file where a folder is needed; choose another path",
    errno.ENOTDIR: "there is a file where a folder is needed; choose another path",
    errno.ENAMETOOLONG: "the name is too long; choose a shorter one",
    errno.EFBIG: "the file is larger than the file system allows; choose another folder",
    errno.EIO: "the disk reports an input/output error; check the disk",
    errno.ENOLCK: "its drive has no file locks; choose a folder on a local disk with -o",
    **dict.fromkeys(MISSING, "its drive lacks a function that polcap needs; choose a folder on a local disk with -o"),
}


def cannot_write(target: Path, error: OSError) -> StorageError:
    """The StorageError to raise for an OSError while writing the file `target`, with reason and remedy if known."""
    reason = _REASONS.get(error.errno or 0, error.strerror or str(error))
    return StorageError(f"cannot write {target}: {reason}")
