# SPDX-License-Identifier: Apache-2.0
"""Build the documentation as a self-contained site: ``python docs/make_site.py [OUT]`` (default: ``site/``).

Needs the packages of requirements-dev.txt. The pages are written for GitHub. Here their mathematics becomes MathML, and files outside
docs/ that they link to become pages, so that every link is checked. A warning is an error.
"""

from __future__ import annotations

import posixpath
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

try:
    from latex2mathml.converter import convert
except ImportError:
    sys.exit("make_site: latex2mathml is missing; pip install -r requirements-dev.txt")

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
_FENCE = re.compile(r"^(```+|~~~+)(\w*)[^\n]*\n(.*?)^\1\s*$", re.M | re.S)
_LINK = re.compile(r"(\]\()([^)\s#:]+)((?:#[^)\s]*)?\))")
_INLINE_MATH = re.compile(r"\$`(.+?)`\$")
_LANGUAGES = {".py": "python", ".toml": "toml", ".yaml": "yaml", ".sh": "sh"}


class SiteError(Exception):
    """The site could not be built."""


def with_mathematics(text: str) -> str:
    """Convert GitHub's ```math fences and $`…`$ to MathML."""

    def fence(found: re.Match[str]) -> str:
        if found[2] != "math":
            return found[0]
        # One line: an empty one would end the block for Markdown.
        mathml = " ".join(convert(found[3].strip(), display="block").split())
        return f'<div class="equation">{mathml}</div>'

    parts, last = [], 0
    for found in _FENCE.finditer(text):
        parts += [_inline(text[last : found.start()]), fence(found)]
        last = found.end()
    return "".join([*parts, _inline(text[last:])])


def _inline(text: str) -> str:
    return _INLINE_MATH.sub(lambda found: convert(found[1]), text)


class Stage:
    """The pages of the site, collected in ``folder``; ``add`` copies a page with everything it links to."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._staged: set[Path] = set()

    def place_of(self, file: Path) -> str:
        """Return the path of a repository file in the site, relative to its root."""
        if file.is_relative_to(DOCS) and file.suffix in (".md", ".jpg", ".png", ".webp", ".svg"):
            return file.relative_to(DOCS).as_posix()
        place = f"source/{file.relative_to(ROOT).as_posix()}"
        return place if file.suffix == ".md" else f"{place}.md"

    def add(self, file: Path) -> None:
        """Add a page or image; a source file becomes a page that shows it. Raises SiteError for a broken link."""
        if file in self._staged:
            return
        self._staged.add(file)
        place = self.folder / self.place_of(file)
        place.parent.mkdir(parents=True, exist_ok=True)
        if file.suffix == ".md":
            text = self.with_links(file.read_text(encoding="utf-8"), file)
            place.write_text(with_mathematics(text), encoding="utf-8")
        elif place.suffix == ".md":
            code = file.read_text(encoding="utf-8").rstrip()
            language = _LANGUAGES.get(file.suffix, "text")
            place.write_text(
                f"# {file.relative_to(ROOT).as_posix()}\n\n````{language}\n{code}\n````\n", encoding="utf-8"
            )
        else:
            shutil.copyfile(file, place)

    def with_links(self, text: str, page: Path) -> str:
        here = posixpath.dirname(self.place_of(page))

        def link(found: re.Match[str]) -> str:
            file = (page.parent / found[2]).resolve()
            file = file / "README.md" if file.is_dir() else file
            if not (file.is_file() and file.is_relative_to(ROOT)):
                raise SiteError(f"{page.relative_to(ROOT)}: {found[2]}: no such file in the repository")
            self.add(file)
            return f"{found[1]}{posixpath.relpath(self.place_of(file), here or '.')}{found[3]}"

        parts, last = [], 0
        for fence in _FENCE.finditer(text):
            parts += [_LINK.sub(link, text[last : fence.start()]), fence[0]]
            last = fence.end()
        return "".join([*parts, _LINK.sub(link, text[last:])])


def pages_of(nav: list[Any]) -> Iterator[str]:
    """Yield the pages of a navigation in order."""
    for entry in nav:
        for place in entry.values():
            yield from pages_of(place) if isinstance(place, list) else (place,)


def configuration(stage: Path) -> str:
    """Return site.toml with the pages of docs/ that it does not list appended under their headings.

    Raises SiteError if it lists a page twice or one that does not exist.
    """
    text = (DOCS / "site.toml").read_text(encoding="utf-8")
    named = list(pages_of(tomllib.loads(text)["project"]["nav"]))
    wrong = [place for place in named if not (stage / place).is_file() or named.count(place) > 1]
    if wrong:
        raise SiteError(f"site.toml: nav: missing or listed twice: {', '.join(wrong)}")
    more = [
        f'    {{ "{page.read_text(encoding="utf-8").partition(chr(10))[0].lstrip("# ")}" = "{page.name}" }},'
        for page in sorted(DOCS.glob("*.md"))
        if page.name not in named
    ]
    if "# MORE" not in text:
        raise SiteError("site.toml: nav: the line # MORE is missing")
    return re.sub(r"^ *# MORE.*$", lambda _: "\n".join(more), text, flags=re.M)


def build(out: Path) -> None:
    """Build the site into ``out``, which is replaced. Raises SiteError with the output of the site generator."""
    with tempfile.TemporaryDirectory(prefix="chaserdock-docs-") as name:
        work = Path(name)
        stage = Stage(work / "pages")
        for page in sorted(DOCS.glob("*.md")):
            stage.add(page)
        (work / "zensical.toml").write_text(configuration(stage.folder), encoding="utf-8")
        done = subprocess.run(
            [str(Path(sys.executable).with_name("zensical")), "build", "--strict"],
            cwd=work,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode != 0:
            raise SiteError(f"{done.stdout}{done.stderr}")
        if out.exists():
            shutil.rmtree(out)
        shutil.copytree(work / "site", out)


def main() -> int:
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "site"
    if out.exists() and not (out / "sitemap.xml").is_file():
        print(f"make_site: {out} exists and is not a site; it would be replaced", file=sys.stderr)
        return 2
    try:
        build(out)
    except SiteError as error:
        print(f"make_site: {error}", file=sys.stderr)
        return 1
    print(out / "index.html")
    return 0


if __name__ == "__main__":
    sys.exit(main())
