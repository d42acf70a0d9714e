"""Modules and tables that workers import before they fork.

Nothing here may start a thread, because a fork does not copy threads. Each worker therefore imports onnxruntime
itself.
"""

import scipy.sparse.linalg
import scipy.special  # noqa: F401

from polcap.batch import thumbnail, unit  # noqa: F401
from polcap.formats.capture import reader  # noqa: F401
from polcap.formats.export import provenance
from polcap.optics import body
from polcap.pipeline import models, run  # noqa: F401

body.make_tables()
provenance.versions()
