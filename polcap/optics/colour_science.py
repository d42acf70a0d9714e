"""The package colour-science (color differences, chart colors, chromatic adaptation), imported without its plots.

The import takes 0.2 s, so functions import this module only where they call it.
"""

import sys
from types import ModuleType

_PLOTS = "colour.plotting"  # it loads Matplotlib; where that is missing, it warns and fills sys.modules with mocks

if "colour" in sys.modules:
    import colour
else:
    sys.modules[_PLOTS] = ModuleType(_PLOTS)
    import colour

    del sys.modules[_PLOTS]

__all__ = ["colour"]
