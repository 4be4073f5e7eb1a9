"""Print the lowest version that pyproject.toml admits of each library, as constraints for pip.

    python .ci/lowest_versions.py EXTRA[,EXTRA...]

Libraries are those of the core, of the extras that are named, and of the build.
"""

import re
import sys
import tomllib
from pathlib import Path

content = tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))
project = content["project"]
extras = project["optional-dependencies"]


def requirements_of(names: str) -> list[str]:
    """Return the requirements of extras, and of the extras of this project that they name."""
    requirements = [requirement for extra in names.split(",") for requirement in extras[extra]]
    out = []
    for requirement in requirements:
        nested = re.fullmatch(rf"{project['name']}\[([\w,]+)\]", requirement)
        out += requirements_of(nested[1]) if nested else [requirement]
    return out


for requirement in (
    *project["dependencies"],
    *requirements_of(sys.argv[1]),
    *content["build-system"]["requires"],
):
    found = re.match(r"([\w.-]+)(?:\[[\w,]+\])?>=([\w.]+)", requirement)
    if found is None:
        raise SystemExit(f"pyproject.toml: {requirement!r} has no lower bound")
    print(f"{found[1]}=={found[2]}")
