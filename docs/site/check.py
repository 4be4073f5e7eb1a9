"""What must hold of the built site.

    python docs/site/check.py FOLDER

Links and anchors within the site lead somewhere, every page is reached from the first one in two
clicks, and no page loads anything from another host. What does not hold is a line each, and makes
the exit code 1.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

MOST_CLICKS = 2
"""Clicks in which every page is to be reached."""
NOT_READ = ("genindex.html", "search.html", "py-modindex.html")
"""Pages that are searched rather than read."""
_LOADED = {"script": "src", "img": "src", "source": "src", "video": "src", "iframe": "src"}
_LOADED_LINKS = ("stylesheet", "icon", "preload", "modulepreload", "preconnect", "shortcut icon")


@dataclass
class Page(HTMLParser):
    """Links, anchors and loaded addresses of a page."""

    links: list[str] = field(default_factory=list)
    """Addresses of its links."""
    anchors: set[str] = field(default_factory=set)
    """Names that links can point to."""
    loaded: list[str] = field(default_factory=list)
    """Addresses of what the browser loads with it."""

    def __post_init__(self) -> None:
        super().__init__()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Keep what a tag names."""
        named = {name: value or "" for name, value in attrs}
        self.anchors |= {named[name] for name in ("id", "name") if name in named}
        if tag == "a" and "href" in named:
            self.links.append(named["href"])
        if tag == "link" and named.get("rel", "") in _LOADED_LINKS:
            self.loaded.append(named.get("href", ""))
        if tag in _LOADED and named.get(_LOADED[tag]):
            self.loaded.append(named[_LOADED[tag]])


def main() -> None:
    """Check a site from the command line."""
    problems = check(Path(sys.argv[1]))
    for problem in problems:
        print(problem, file=sys.stderr)
    sys.exit(bool(problems))


def check(folder: Path) -> list[str]:
    """What does not hold of a site, a line each.

    Args:
        folder: the built site.
    """
    pages = {}
    for path in sorted(folder.rglob("*.html")):
        if "_static" not in path.relative_to(folder).parts:
            page = Page()
            page.feed(path.read_text("utf-8"))
            pages[path.relative_to(folder).as_posix()] = page
    problems = []
    for name, page in pages.items():
        problems += [
            f"{name}: loads {address}, which is of another host"
            for address in page.loaded
            if urlsplit(address).netloc
        ]
        for link in page.links:
            problem = _problem_of_link(folder, pages, name, link)
            if problem:
                problems.append(f"{name}: link to {link}: {problem}")
    clicks = _clicks(pages)
    problems += [
        f"{name}: is {clicks.get(name, 'no number of')} clicks from the first page; valid are at "
        f"most {MOST_CLICKS}"
        for name in pages
        if name not in NOT_READ and clicks.get(name, MOST_CLICKS + 1) > MOST_CLICKS
    ]
    return problems


def _problem_of_link(folder: Path, pages: Mapping[str, Page], name: str, link: str) -> str:
    """What is wrong with a link; empty if nothing is, or if it leaves the site."""
    target = _target(name, link)
    if target is None:
        return ""
    if target not in pages:
        return "" if (folder / target).is_file() else "there is no such page"
    anchor = unquote(urlsplit(link).fragment)
    if anchor and anchor not in pages[target].anchors:
        return "the page has no such place"
    return ""


def _target(name: str, link: str) -> str | None:
    """Path that a link on a page leads to; None if it leaves the site."""
    parts = urlsplit(link)
    if parts.scheme or parts.netloc:
        return None
    if not parts.path:
        return name
    base = Path("/", name).parent
    target = Path(*_normal((base / unquote(parts.path)).parts[1:]))
    return (target / "index.html" if parts.path.endswith("/") else target).as_posix()


def _normal(parts: tuple[str, ...]) -> list[str]:
    """Parts of a path without ``..``."""
    found: list[str] = []
    for part in parts:
        if part == "..":
            del found[-1:]
        elif part != ".":
            found.append(part)
    return found


def _clicks(pages: Mapping[str, Page]) -> dict[str, int]:
    """Clicks in which each page is reached from the first."""
    clicks, rest = {"index.html": 0}, ["index.html"]
    for name in rest:
        for link in pages[name].links:
            target = _target(name, link)
            if target is not None and target in pages and target not in clicks:
                clicks[target] = clicks[name] + 1
                rest.append(target)
    return clicks


if __name__ == "__main__":
    main()
