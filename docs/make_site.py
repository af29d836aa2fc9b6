# SPDX-License-Identifier: Apache-2.0
"""Build the documentation as a self-contained site: ``python docs/make_site.py [OUT]`` (default:
``site/``).

Needs the packages of requirements-dev.txt. The pages are written for GitHub. Here their mathematics
becomes MathML, and files outside docs/ that they link to become pages, so that every link is
checked; notebooks are shown with their stored outputs. A warning is an error. Every page names the
version. ``--releases`` adds the documentation of each tag vX.Y.Z in a folder of that name, each
built by its own make_site.py, and the page ``versions.html``, to which the first page links.
Searching needs a server: ``python -m http.server -d site``.
"""

from __future__ import annotations

import argparse
import base64
import json
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


_SHOWN = frozenset({"", "math", "text", "sh", "python", "toml", "yaml", "json", "sql", "c", "cpp"})
"""Languages of fences that the site shows as what they are. A diagram in another one, such as
mermaid, would be shown as its source text: the page makes no requests, so it has no script for it.
"""


class SiteError(Exception):
    """The site could not be built."""


def with_mathematics(text: str) -> str:
    """Convert GitHub's ```math fences and $`…`$ to MathML."""

    def fence(found: re.Match[str]) -> str:
        if found[2] != "math":
            return found[0]
        # One line: an empty one would end the block for Markdown.
        mathml = " ".join(convert(found[3].strip(), display="block").split())
        return f'<div class="equation" style="overflow-x: auto; overflow-y: hidden">{mathml}</div>'

    parts, last = [], 0
    for found in _FENCE.finditer(text):
        parts += [_inline(text[last : found.start()]), fence(found)]
        last = found.end()
    return "".join([*parts, _inline(text[last:])])


def _inline(text: str) -> str:
    return _INLINE_MATH.sub(lambda found: convert(found[1]), text)


def notebook_page(file: Path, images: Path) -> str:
    """Return a notebook with its stored outputs as Markdown; its figures are written into the
    folder ``images``.
    """
    parts = []
    for number, cell in enumerate(json.loads(file.read_text(encoding="utf-8"))["cells"]):
        source = "".join(cell["source"]).rstrip()
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        for k, output in enumerate(cell["outputs"]):
            data = output.get("data", {})
            if "image/png" in data:
                images.mkdir(parents=True, exist_ok=True)
                name = f"{file.stem}-{number}-{k}.png"
                (images / name).write_bytes(base64.b64decode("".join(data["image/png"])))
                parts.append(f"![output of the cell above]({name})")
            else:
                text = "".join(data.get("text/plain") or output.get("text", "")).rstrip()
                parts.append(f"````text\n{text}\n````")
    return "\n\n".join(parts) + "\n"


class Stage:
    """The pages of the site, collected in ``folder``; ``add`` copies a page with everything it
    links to.
    """

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
        """Add a page or image; a source file becomes a page that shows it. Raises SiteError for a
        broken link.
        """
        if file in self._staged:
            return
        self._staged.add(file)
        place = self.folder / self.place_of(file)
        place.parent.mkdir(parents=True, exist_ok=True)
        if file.suffix == ".md":
            text = self.with_links(file.read_text(encoding="utf-8"), file)
            if hidden := {found[2] for found in _FENCE.finditer(text)} - _SHOWN:
                raise SiteError(
                    f"{file.relative_to(ROOT)}: ```{min(hidden)} would be shown as its source "
                    "text; show a picture"
                )
            place.write_text(with_mathematics(text), encoding="utf-8")
        elif file.suffix == ".ipynb":
            text = self.with_links(notebook_page(file, place.parent), file)
            place.write_text(text, encoding="utf-8")
        elif place.suffix == ".md":
            code = file.read_text(encoding="utf-8").rstrip()
            language = _LANGUAGES.get(file.suffix, "text")
            place.write_text(
                f"# {file.relative_to(ROOT).as_posix()}\n\n````{language}\n{code}\n````\n",
                encoding="utf-8",
            )
        else:
            shutil.copyfile(file, place)

    def with_links(self, text: str, page: Path) -> str:
        here = posixpath.dirname(self.place_of(page))

        def link(found: re.Match[str]) -> str:
            if page.suffix == ".ipynb" and (self.folder / here / found[2]).is_file():
                return found[0]  # a figure of the notebook
            file = (page.parent / found[2]).resolve()
            file = file / "README.md" if file.is_dir() else file
            if not (file.is_file() and file.is_relative_to(ROOT)):
                raise SiteError(
                    f"{page.relative_to(ROOT)}: {found[2]}: no such file in the repository"
                )
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
    places = {page.relative_to(DOCS).as_posix(): page for page in sorted(DOCS.rglob("*.md"))}
    more = [
        f'    {{ "{_title(page)}" = "{place}" }},'
        for place, page in places.items()
        if place not in named
    ]
    if "# MORE" not in text:
        raise SiteError("site.toml: nav: the line # MORE is missing")
    return re.sub(r"^ *# MORE.*$", lambda _: "\n".join(more), text, flags=re.M)


def _title(page: Path) -> str:
    """Return the heading of a page, its first line."""
    return page.read_text(encoding="utf-8").partition("\n")[0].lstrip("# ")


def version() -> str:
    """Return the version that the pages describe."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"][
        "version"
    ]


def build_releases(out: Path) -> list[str]:
    """Build the documentation of each release into a folder of ``out``, newest first; return their
    tags. Raises SiteError.
    """
    listed = subprocess.run(
        ["git", "tag", "--list", "v[0-9]*.[0-9]*.[0-9]*", "--sort=-v:refname"],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if listed.returncode != 0:
        raise SiteError(f"--releases needs a clone with its tags: {listed.stderr.strip()}")
    tags = listed.stdout.split()
    for tag in tags:
        with tempfile.TemporaryDirectory(prefix="chaserdock-docs-") as name:
            for command in (
                ["git", "worktree", "add", "--detach", f"{name}/tree", tag],
                [sys.executable, f"{name}/tree/docs/make_site.py", str(out / tag)],
                ["git", "worktree", "remove", "--force", f"{name}/tree"],
            ):
                done = subprocess.run(
                    command, cwd=ROOT, capture_output=True, text=True, check=False
                )
                if done.returncode != 0:
                    raise SiteError(f"{tag}: {' '.join(command)}: {done.stdout}{done.stderr}")
    items = "".join(f'<li><a href="{tag}/index.html">{tag}</a></li>' for tag in tags)
    (out / "versions.html").write_text(
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width">'
        "<title>chaserdock: versions</title><h1>chaserdock: versions</h1>"
        f'<ul><li><a href="index.html">{version()}</a>'
        f" (this build)</li>{items}</ul></html>\n",
        encoding="utf-8",
    )
    home = out / "index.html"
    text = home.read_text(encoding="utf-8")
    if "</article>" not in text:
        raise SiteError(f"{home}: no place for the link to versions.html")
    link = '<p><a href="versions.html">All versions of this documentation</a></p></article>'
    home.write_text(text.replace("</article>", link, 1), encoding="utf-8")
    return tags


def build(out: Path) -> None:
    """Build the site into ``out``, which is replaced. Raises SiteError with the output of the site
    generator.
    """
    with tempfile.TemporaryDirectory(prefix="chaserdock-docs-") as name:
        work = Path(name)
        stage = Stage(work / "pages")
        for page in sorted(DOCS.rglob("*.md")):
            stage.add(page)
        for notebook in sorted((ROOT / "examples").glob("*.ipynb")):
            stage.add(notebook)
        text = configuration(stage.folder).replace('"chaserdock"', f'"chaserdock {version()}"', 1)
        (work / "zensical.toml").write_text(text, encoding="utf-8")
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
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", nargs="?", type=Path, default=ROOT / "site", metavar="OUT")
    parser.add_argument("--releases", action="store_true", help="add the documentation of each tag")
    options = parser.parse_args()
    out: Path = options.out
    if out.exists() and not (out / "sitemap.xml").is_file():
        print(f"make_site: {out} exists and is not a site; it would be replaced", file=sys.stderr)
        return 2
    try:
        build(out)
        if options.releases:
            build_releases(out.resolve())
    except SiteError as error:
        print(f"make_site: {error}", file=sys.stderr)
        return 1
    print(out / "index.html")
    return 0


if __name__ == "__main__":
    sys.exit(main())
