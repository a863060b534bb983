"""What MkDocs needs beyond mkdocs.yml: pages and links outside of docs/, and references in docstrings.

The pages are written for the repository's web view. There, links lead to any file of the repository, and headings get
anchors by GitHub's rule. The hooks below (MkDocs calls them by name) make the same links work in the site.
"""

from __future__ import annotations

import os
import re
from pathlib import Path, PurePosixPath
from typing import Any

import griffe
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "packages/import-ark/README.md": "coming-from-ark.md",
    "packages/lerobot_robot_hal/README.md": "lerobot.md",
}
"""Files outside of docs/ -> pages of the site. The README's own page is the index, which has more links."""

_LINK = re.compile(r"(?<=\]\()(?![a-z]+:|#)([^)\s#]+)")
_FENCE = re.compile(r"(^```.*?^```)", re.MULTILINE | re.DOTALL)


def anchor_of(heading: str, separator: str = "-") -> str:
    """Return the anchor that GitHub gives a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", separator)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Give headings the anchors that they have in the repository's web view."""
    config.mdx_configs.setdefault("toc", {})["slugify"] = anchor_of
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages from the root, and every file outside of docs/ that a page links to."""
    for name, page in PAGES.items():
        if page not in files.src_uris:
            files.append(File.generated(config, page, abs_src_path=str(ROOT / name)))
    for page in list(files.documentation_pages()):
        for link in _LINK.findall(page.content_string):
            target = _place_in_site(_place_in_repository(page.src_uri, link))
            if target.startswith("files/") and target not in files.src_uris:
                source = ROOT / target.removeprefix("files/")
                if source.is_file():
                    files.append(File.generated(config, target, abs_src_path=str(source)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Point the links of a page to where their targets are in the site."""

    def moved(match: re.Match[str]) -> str:
        target = _place_in_site(_place_in_repository(page.file.src_uri, match.group(1)))
        return os.path.relpath(target, PurePosixPath(page.file.src_uri).parent)

    parts = _FENCE.split(markdown)
    return "".join(part if part.startswith("```") else _LINK.sub(moved, part) for part in parts)


def _place_in_repository(page: str, link: str) -> str:
    """Return the path in the repository that a link of a page leads to."""
    own = next((name for name, place in PAGES.items() if place == page and name != "README.md"), f"docs/{page}")
    return os.path.normpath(PurePosixPath(own).parent / link)


def _place_in_site(path: str) -> str:
    """Return the path in the site of a file of the repository."""
    if path in PAGES:
        return PAGES[path]
    return path.removeprefix("docs/") if path.startswith("docs/") else f"files/{path}"


class SphinxRoles(griffe.Extension):
    """Turns the references of docstrings, such as :class:`~hal.control.Control`, into links of the site."""

    _ROLE = re.compile(r":(?:class|meth|func|mod|data|attr|exc|obj):`(~?)([^`]+)`")

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        """Rewrite every docstring of a package."""
        self._rewrite(pkg)

    def _rewrite(self, owner: griffe.Object) -> None:
        if owner.docstring:
            text = self._ROLE.sub(lambda match: self._link(owner, match), owner.docstring.value)
            owner.docstring.value = re.sub(r"::$", ":", text, flags=re.MULTILINE)
        for member in owner.members.values():
            if not member.is_alias:
                self._rewrite(member)  # type: ignore[arg-type]

    @staticmethod
    def _link(owner: griffe.Object, match: re.Match[str]) -> str:
        short, path = match.groups()
        shown = path.rsplit(".", 1)[-1] if short else path
        try:
            target = path if path.startswith("hal.") else owner.resolve(path)
        except griffe.NameResolutionError:
            return f"`{shown}`"
        return f'<autoref identifier="{target}" optional><code>{shown}</code></autoref>'
