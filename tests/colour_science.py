"""The package `colour`, which tests hold polcap's colors against."""

import sys
import unittest.mock
import warnings
from typing import Any


def load() -> Any:
    """`colour`, without what it leaves behind.

    colour-science 0.4.7 puts MagicMock objects into sys.modules for each optional package it does not
    find, and trimesh then takes them for the real ones: they are removed again.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour
    for name in [n for n, module in sys.modules.items() if isinstance(module, unittest.mock.MagicMock)]:
        del sys.modules[name]
    return colour
