"""Print the notes of a release, once its tag fits the version that all files name.

python .ci/release_notes.py TAG
"""

import re
import sys
import tomllib
from pathlib import Path


def notes(root: Path, tag: str) -> str:
    """The section of the changelog about a release.

    Args:
        root: folder of the repository.
        tag: tag of the release, such as ``v0.2.0``.

    Raises:
        SystemExit: tag, package, changelog and citation do not name one version, or the changelog
            gives no date.
    """
    project = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]
    version = project["version"]
    if tag != f"v{version}":
        raise SystemExit(
            f"tag {tag}: pyproject.toml has version {version}, expected tag v{version}"
        )
    if not re.fullmatch(r"\d+\.\d+\.\d+", version):
        raise SystemExit(
            f"pyproject.toml: version {version} is not that of a release such as 0.2.0"
        )
    cited = re.search(r"^version: (\S+)$", (root / "CITATION.cff").read_text("utf-8"), re.M)
    if cited is None or cited[1] != version:
        raise SystemExit(f"CITATION.cff: expected version {version}")
    changelog = (root / "CHANGELOG.md").read_text("utf-8")
    heading = rf"^## \[{re.escape(version)}\] - \d{{4}}-\d{{2}}-\d{{2}}\n"
    section = re.search(rf"{heading}(.*?)(?=^## |\Z)", changelog, re.M | re.S)
    if section is None or not section[1].strip():
        raise SystemExit(
            f"CHANGELOG.md: expected a section '## [{version}] - YYYY-MM-DD' with text"
        )
    return section[1].strip() + "\n"


if __name__ == "__main__":
    print(notes(Path(__file__).parents[1], sys.argv[1]), end="")
