"""The array namespace, NumPy or torch, of arrays: physics is written once for both."""

from typing import Any

import numpy as np


def array_namespace(*arrays: Any) -> Any:
    """The array API namespace of these arrays: NumPy, or torch through `array_api_compat`."""
    if all(isinstance(array, (np.ndarray, np.generic)) for array in arrays):
        return np
    import array_api_compat

    return array_api_compat.array_namespace(*arrays)
