"""Scripts that measure the figures of the documentation; they import each other by name, also after `python -m`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
