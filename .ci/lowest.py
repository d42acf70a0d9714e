"""Print pip constraints that pin each runtime dependency to the lowest version that pyproject.toml allows."""

import re
import tomllib
from pathlib import Path

project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
for name, version in re.findall(r"([\w.-]+)>=([\d.]+)", "\n".join(project["dependencies"])):
    print(f"{name}=={version}.*")
