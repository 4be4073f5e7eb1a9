"""Print the lowest version that pyproject.toml admits of each library, as constraints for pip."""

import re
import tomllib
from pathlib import Path

content = tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))
project = content["project"]
extras = project["optional-dependencies"]
for requirement in (
    *project["dependencies"],
    *extras["plot"],
    *extras["fetch"],
    *extras["test"],
    *content["build-system"]["requires"],
):
    found = re.match(r"([\w.-]+)>=([\w.]+)", requirement)
    if found is None:
        raise SystemExit(f"pyproject.toml: {requirement!r} has no lower bound")
    print(f"{found[1]}=={found[2]}")
