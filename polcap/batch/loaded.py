"""In: nothing. Out: what every capture needs, imported or made, also what the path itself comes to only later.

Imported by the process that workers are forked from. Nothing here may start a thread: a fork would not copy it. So
onnxruntime, whose import starts one, is left to each worker.
"""

import scipy.sparse.linalg
import scipy.special  # noqa: F401

from polcap import models, pipeline, resource_limits  # noqa: F401
from polcap.batch import thumbnail, unit  # noqa: F401
from polcap.formats import capture, provenance  # noqa: F401
from polcap.optics import (
    body,
    colour_science,  # noqa: F401
)

body.make_tables()
provenance.versions()
resource_limits.keep_imported()  # a look for garbage writes to, and so copies, what workers share
