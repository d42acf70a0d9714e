"""In: nothing. Out: what every capture needs, imported or made, also what the path itself comes to only later.

Imported by the process that workers are forked from. Nothing here may start a thread: a fork would not copy it. So
onnxruntime, whose import starts one, is left to each worker.
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
