"""The source of the documentation site: pages of the repository, put where the site has them.

    python docs/site/stage.py OUT

copies the Markdown and the pictures of docs/ to OUT, and the pages that lie elsewhere to
OUT/development. Links between pages are rewritten; those to other files of the repository become
their paths, since the site holds no sources. A link to nothing is an error.
"""

from __future__ import annotations

import importlib
import os
import posixpath
import re
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
ELSEWHERE = {
    "CONTRIBUTING.md": "development/contributing.md",
    "CHANGELOG.md": "development/changelog.md",
    "kernels/README.md": "development/kernels.md",
    "data/README.md": "development/embedded-data.md",
    "tests/reference/energyplus/README.md": "development/energyplus-tables.md",
}
"""Pages outside of docs/, by their path in the repository, and their places on the site."""
FIELDS_PAGE = "docs/configuration.md"
"""Page with a table of fields for each section of a configuration."""
SUFFIXES = (".md", ".ipynb", ".webp", ".png", ".svg", ".jpg")
"""Endings of files of docs/ that the site holds."""

_LINK_OR_CODE = re.compile(
    r"^(?P<fence>```+|~~~+).*?^(?P=fence)[^\S\n]*$"
    r"|(?P<bang>!?)\[(?P<text>(?:[^\[\]]|\[[^\[\]]*\])*)\]\((?P<to>[^)\s]+)\)"
    r"|`[^`\n]+`",
    re.M | re.S,
)

_TABLE = re.compile(r"^<!-- table: (?P<module>[\w.]+):(?P<function>\w+) -->$", re.M)


def main() -> None:
    """Stage the site from the command line."""
    out = Path(sys.argv[1])
    errors = stage(out)
    for error in errors:
        print(error, file=sys.stderr)
    sys.exit(bool(errors))


def stage(out: Path) -> list[str]:
    """Write the source of the site; what has not changed keeps its time.

    Args:
        out: folder of the source of the site.

    Returns:
        Links that lead nowhere, a line each.
    """
    places = site_places()
    errors: list[str] = []
    for path, place in places.items():
        content = (ROOT / path).read_bytes()
        if path.endswith(".md"):
            text = with_tables(content.decode())
            if path == FIELDS_PAGE:
                text = with_field_anchors(text)
            text = with_site_links(text, path, places, errors.append)
            content = text.encode()
        write(out / place, content)
    kept = {out / place for place in places.values()}
    for old in out.rglob("*"):
        is_generated = "generated" in old.relative_to(out).parts
        if old.is_file() and old not in kept and not is_generated:
            old.unlink()
    return errors


def site_places() -> dict[str, str]:
    """Place on the site of each file that it holds, by its path in the repository."""
    docs = ROOT / "docs"
    found = {
        path.relative_to(ROOT).as_posix(): path.relative_to(docs).as_posix()
        for path in sorted(docs.rglob("*"))
        if path.suffix in SUFFIXES and "site" not in path.relative_to(docs).parts
    }
    return found | ELSEWHERE


def with_site_links(
    text: str, path: str, places: dict[str, str], on_error: Callable[[str], None]
) -> str:
    """A page with links as its place on the site needs them.

    Args:
        text: Markdown of the page.
        path: its path in the repository.
        places: places on the site by path in the repository.
        on_error: called with each link that leads nowhere.
    """

    def rewritten(match: re.Match[str]) -> str:
        to, text = match["to"], match["text"]
        name, _, anchor = (to or "").partition("#")  # there is none in code
        if not name or "://" in to or to.startswith("mailto:"):
            return match[0]
        target = posixpath.normpath(posixpath.join(posixpath.dirname(path), name))
        if target in places:
            own = posixpath.dirname(places[path]) or "."
            short = posixpath.relpath(places[target], own)
            if text == posixpath.basename(name) or text == name:
                text = title_of(target)
            return f"{match['bang']}[{text}]({short}{'#' * bool(anchor)}{anchor})"
        if is_generated(target):
            return match[0]
        if not (ROOT / target).exists():
            on_error(f"{path}: link to {to}: there is no such file")
        return text if text.strip("`") in target else f"{text} (`{target}`)"

    return _LINK_OR_CODE.sub(rewritten, text)


def with_tables(text: str) -> str:
    """A page with the tables that code makes, each in place of its line ``<!-- table: ... -->``.

    The line names a function without arguments that returns Markdown, as ``module:function``.
    """

    def made(match: re.Match[str]) -> str:
        table = getattr(importlib.import_module(match["module"]), match["function"])
        return str(table()).strip()

    return _TABLE.sub(made, text)


def with_field_anchors(text: str) -> str:
    """The page of configuration fields with an anchor at each, such as ``hvac.setpoint.step_k``."""
    lines, section = [], ""
    for line in text.splitlines():
        if heading := re.fullmatch(r"## (?:`(.+)`|.*)", line):
            section = (heading[1] or "").replace("[]", "")
        if field := re.match(r"\| `(\w+)` \|", line):
            anchor = f"{section}.{field[1]}".lstrip(".")
            line = line.replace("| ", f'| <span id="{anchor}"></span>', 1)
        lines.append(line)
    return "\n".join(lines) + "\n"


@cache
def title_of(path: str) -> str:
    """Title of a page of the repository, by which the site names it."""
    return (ROOT / path).read_text("utf-8").partition("\n")[0].removeprefix("# ")


def is_generated(target: str) -> bool:
    """Whether a path of the repository is that of a page that the build makes."""
    return target.startswith("docs/reference/generated/")


def write(path: Path, content: bytes) -> None:
    """Write a file unless it has this content."""
    if path.is_file() and path.read_bytes() == content:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.name}.part")
    temporary.write_bytes(content)
    os.replace(temporary, path)


if __name__ == "__main__":
    main()
