"""colour-science without its plots: color differences, chart colors, chromatic adaptation.

The import takes .2 s, so functions import this module where they call it, and `process` while it decodes photographs.
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
