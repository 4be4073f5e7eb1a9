"""Builds of the site side by side, between which readers choose.

    python docs/site/versions.py PAGES BUILD NAME ADDRESS

puts a build into folder NAME of PAGES, in place of an older one, and writes what leads to all of
them: ``switcher.json``, which the pages read, and an ``index.html`` that leads to the newest
release, or to ``dev`` where there is none. PAGES are served at ADDRESS.
"""

from __future__ import annotations

import json
import re
import shutil
import sys
from pathlib import Path

_VERSION = re.compile(r"\d+(\.\d+)*")
_INDEX = """<!doctype html>
<meta charset="utf-8">
<title>sdc-taichi</title>
<meta http-equiv="refresh" content="0; url={name}/">
<a href="{name}/">sdc-taichi {name}</a>
"""


def main() -> None:
    """Put a build among the others from the command line."""
    pages, build, name, address = sys.argv[1:]
    put(Path(pages), Path(build), name, address)


def put(pages: Path, build: Path, name: str, address: str) -> None:
    """Put a build among the others.

    Args:
        pages: folder of all builds.
        build: folder of the build.
        name: ``dev``, or the version of a release.
        address: where the folder of all builds is served, with a slash at its end.

    Raises:
        SystemExit: the name is none of these, or the build has no first page.
    """
    if name != "dev" and not _VERSION.fullmatch(name):
        raise SystemExit(f"{name}: expected dev or a version such as 0.2.0")
    if not (build / "index.html").is_file():
        raise SystemExit(f"{build}: has no index.html, expected a build of the site")
    shutil.rmtree(pages / name, ignore_errors=True)
    shutil.copytree(build, pages / name)
    names = [path.parent.name for path in pages.glob("*/index.html")]
    releases = sorted(filter(_VERSION.fullmatch, names), key=_parts, reverse=True)
    listed = [*(["dev"] if "dev" in names else []), *releases]
    newest = releases[0] if releases else "dev"
    entries = [
        {"name": f"{x} (newest)" if x == newest else x, "version": x, "url": f"{address}{x}/"}
        | ({"preferred": True} if x == newest else {})
        for x in listed
    ]
    (pages / "switcher.json").write_text(json.dumps(entries, indent=1) + "\n", "utf-8")
    (pages / "index.html").write_text(_INDEX.format(name=newest), "utf-8")
    # GitHub would leave out folders that begin with an underscore.
    (pages / ".nojekyll").touch()


def _parts(version: str) -> tuple[int, ...]:
    """Numbers of a version, by which it is older or newer than others."""
    return tuple(map(int, version.split(".")))


if __name__ == "__main__":
    main()
