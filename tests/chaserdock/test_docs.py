# SPDX-License-Identifier: Apache-2.0
"""The documentation: builds strictly, needs no network, and says nothing that the repository
contradicts.
"""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
import tomllib
from html.parser import HTMLParser
from pathlib import Path
from types import ModuleType
from typing import Any
from urllib.parse import unquote

import numpy as np
import pytest
from chaserdock_controller.guidance.phases import TRANSITIONS
from chaserdock_protocol.scenario import parse_scenario
from harness import ROOT
from source_tree import MODULES

from chaserdock.experiments.reproduction import curves
from chaserdock.experiments.reproduction.paper import ROWS

DOCS = ROOT / "docs"
PAGES = sorted(DOCS.glob("*.md"))
EVIDENCE = sorted((DOCS / "evidence").glob("*.md"))
GENERATED = {
    "api.md",
    "cli.md",
    "invariants.md",
    "phases.md",
    "protocol.md",
    "reproduction.md",
    "scenario.md",
}
GUIDES = [page for page in PAGES if page.name not in GENERATED | {"results.md"}]
WRITTEN = [
    *(page for page in (*PAGES, *EVIDENCE) if page.name not in GENERATED),
    *(ROOT / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")),
    ROOT / "examples" / "README.md",
]
"""Markdown that people write."""


def _module(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # for its dataclasses
    spec.loader.exec_module(module)
    return module


make_site: Any = _module("make_site")
make_api: Any = _module("make_api")
make_images: Any = _module("make_images")
make_phases: Any = _module("make_phases")


class Requests(HTMLParser):
    """What a browser would fetch for a page by itself."""

    def __init__(self) -> None:
        super().__init__()
        self.urls: list[str] = []
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.equations = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.equations += tag == "math"
        if values.get("id"):
            self.anchors.add(str(values["id"]))
        if tag == "a" and values.get("href"):
            self.links.append(str(values["href"]))
        if tag in ("script", "img", "iframe", "source", "video") and values.get("src"):
            self.urls.append(str(values["src"]))
        if tag == "link" and values.get("rel") not in ("canonical", "next", "prev"):
            self.urls.append(str(values.get("href")))


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("docs") / "site"
    made = subprocess.run(
        [sys.executable, str(DOCS / "make_site.py"), str(out)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert made.returncode == 0, made.stdout + made.stderr
    return out


@pytest.mark.slow
def test_every_page_exists_and_loads_nothing_from_elsewhere(site: Path) -> None:
    for page in (*PAGES, *EVIDENCE):
        assert (site / page.relative_to(DOCS).with_suffix(".html")).is_file()
    for page in site.rglob("*.html"):
        seen = Requests()
        seen.feed(page.read_text(encoding="utf-8"))
        foreign = [url for url in seen.urls if re.match(r"(https?:)?//", url)]
        assert foreign == [], page
        for url in seen.urls:
            if page.name != "404.html" and not url.startswith("data:"):
                assert (page.parent / url.partition("?")[0].partition("#")[0]).exists(), (page, url)


@pytest.mark.slow
def test_every_link_leads_to_a_page_and_a_heading_of_the_site(site: Path) -> None:
    pages: dict[Path, Requests] = {}
    for page in site.rglob("*.html"):
        pages[page.resolve()] = Requests()
        pages[page.resolve()].feed(page.read_text(encoding="utf-8"))
    checked = 0
    for page, seen in pages.items():
        for link in seen.links:
            if page.name == "404.html" or re.match(r"[a-z]+:", link):
                continue
            place, _, anchor = unquote(link).partition("#")
            to = (page.parent / place).resolve() if place else page
            assert to.is_file(), (page, link)
            assert not anchor or to not in pages or anchor in pages[to].anchors, (page, link)
            checked += 1
    assert checked > 1000


@pytest.mark.slow
def test_mathematics_is_in_the_page_itself(site: Path) -> None:
    for name, least in (("controller", 8), ("estimation", 4)):
        seen = Requests()
        text = (site / f"{name}.html").read_text(encoding="utf-8")
        seen.feed(text)
        assert seen.equations >= least
        assert "\\begin" not in re.sub(r"<annotation.*?</annotation>", "", text, flags=re.S)


@pytest.mark.slow
def test_the_site_shows_notebooks_names_its_version_and_can_be_searched(site: Path) -> None:
    page = (site / "source" / "examples" / "logs.ipynb.html").read_text(encoding="utf-8")
    assert "controller: initialised by chaser 1" in page  # a stored output
    assert page.count("<img") >= 1
    assert f"chaserdock {make_site.version()}" in (site / "index.html").read_text(encoding="utf-8")
    index = (site / "search.json").read_text(encoding="utf-8")
    assert "logs.ipynb.html" in index
    assert "api.html" in index


def test_api_page_is_up_to_date() -> None:
    assert make_api.page() == (DOCS / "api.md").read_text(encoding="utf-8")


def test_documentation_of_releases(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each tag's own make_site.py builds it into a folder with its name; versions.html lists them,
    newest first.
    """
    clone = tmp_path / "clone"
    (clone / "docs").mkdir(parents=True)
    script = (
        "import pathlib, sys; p = pathlib.Path(sys.argv[1]); p.mkdir(); (p / "
        "'index.html').write_text('x')\n"
    )
    (clone / "docs" / "make_site.py").write_text(script)
    own = ("-c", "user.name=test", "-c", "user.email=test@example.org")
    for command in (
        ["init", "-q"],
        ["add", "."],
        ["commit", "-qm", "x"],
        ["tag", "v0.9.0"],
        ["tag", "v0.10.0"],
    ):
        subprocess.run(["git", *own, *command], cwd=clone, check=True)
    monkeypatch.setattr(make_site, "ROOT", clone)
    monkeypatch.setattr(make_site, "version", lambda: "0.11.0.dev1")
    out = tmp_path / "site"
    out.mkdir()
    (out / "index.html").write_text("<article>x</article>")
    assert make_site.build_releases(out) == ["v0.10.0", "v0.9.0"]
    assert (out / "v0.9.0" / "index.html").is_file()
    listed = re.findall(r'href="([^"]+)"', (out / "versions.html").read_text(encoding="utf-8"))
    assert 'href="versions.html"' in (out / "index.html").read_text(encoding="utf-8")
    assert listed == ["index.html", "v0.10.0/index.html", "v0.9.0/index.html"]


def test_a_link_to_nowhere_is_an_error(tmp_path: Path) -> None:
    stage = make_site.Stage(tmp_path / "stage")
    with pytest.raises(make_site.SiteError, match=r"nothing\.md"):
        stage.with_links("[gone](nothing.md)", DOCS / "index.md")
    assert stage.with_links("[there](../examples/README.md)", DOCS / "index.md") == (
        "[there](source/examples/README.md)"
    )
    assert (tmp_path / "stage" / "source" / "examples" / "README.md").is_file()


def test_a_diagram_that_would_be_shown_as_its_source_text_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(make_site, "ROOT", tmp_path)
    monkeypatch.setattr(make_site, "DOCS", tmp_path)
    page = tmp_path / "page.md"
    page.write_text("# Page\n\n```mermaid\nstateDiagram-v2\n```\n", encoding="utf-8")
    stage = make_site.Stage(tmp_path / "stage")
    with pytest.raises(make_site.SiteError, match=r"page\.md: ```mermaid would be shown as its"):
        stage.add(page)


@pytest.mark.parametrize("by_capture", [False, True])
def test_phase_diagrams_show_every_transition(by_capture: bool) -> None:
    """As an arrow of its own, or beside its target with its sources or their number."""
    several, single = make_phases.triggers(by_capture)
    shown = {t for t in TRANSITIONS if t.by_capture in (None, by_capture)}
    drawn = {(target, line) for target, lines in several.items() for line in lines}
    for t in shown:
        beside = any(target == t.target and line.startswith(t.trigger) for target, line in drawn)
        alone = all(t.trigger in single.get((s, t.target), "") for s in t.sources)
        assert beside or alone, t
    phases = {p for t in shown for p in (*t.sources, t.target)}
    assert phases <= make_phases._AT[by_capture].keys()
    assert several.keys() <= make_phases._BESIDE[by_capture].keys()


def test_curves_of_the_reproduction_are_those_of_its_tables(tmp_path: Path) -> None:
    """The committed picture is drawn from the committed page; the page shows it."""
    text = (DOCS / "reproduction.md").read_text(encoding="utf-8")
    assert "](images/reproduction-curves.svg)" in text
    tables = make_images.tables_of_reproduction(text)
    ours = curves.ratios(tables, "position", "ours")
    assert ours.keys() == {row.label for row in ROWS}
    axes = curves.curves(tables).axes
    assert len(axes) == 6
    drawn = {line.get_label(): np.asarray(line.get_xydata()) for line in axes[0].get_lines()}
    expected = [
        (r.horizon_s, ours[r.label] * r.position_mse_m2) for r in curves.varied("horizon_s")
    ]
    assert drawn["ours"].tolist() == [pytest.approx(point) for point in expected]
    assert [r.horizon_s for r in curves.varied("horizon_s")] == [0.5, 3.0, 10.0]


def test_pictures_are_small() -> None:
    """Of a film, 2 MB."""
    films = {"demo.webp", "four-chaser-docking.webp", "markerless-docking.webp"}
    large = {p.name for p in (DOCS / "images").iterdir() if p.stat().st_size > 150_000}
    assert large <= films


def test_navigation_names_pages_that_are_there(tmp_path: Path) -> None:
    with pytest.raises(make_site.SiteError, match=r"missing.*index\.md"):
        make_site.configuration(tmp_path)


def test_links_of_pages_outside_the_site_lead_somewhere() -> None:
    for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "examples/README.md"):
        page = ROOT / name
        links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))
        assert links
        assert [link for link in links if not (page.parent / link).exists()] == [], name


def test_pages_that_sources_name_exist() -> None:
    """Also their headings: ``docs/controller.md#far-range``."""
    named = set[str]()
    for _, file in MODULES:
        named |= set(re.findall(r"docs/[\w/-]+\.md(?:#[\w-]+)?", file.read_text("utf-8")))
    assert len(named) > 10
    for name in named:
        place, _, heading = name.partition("#")
        assert (ROOT / place).is_file(), name
        titles = re.findall(r"^#+ (.*)", (ROOT / place).read_text(encoding="utf-8"), re.M)
        anchors = {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}
        assert not heading or heading in anchors, name


def test_texts_are_short_enough_to_be_read() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 600
    assert len((ROOT / "CHANGELOG.md").read_text(encoding="utf-8").splitlines()) <= 120


def test_lines_have_at_most_120_characters() -> None:
    """Except rows of tables, and the two commands of the README that .ci/run executes."""
    long = [
        f"{page.relative_to(ROOT)}:{number}"
        for page in (*WRITTEN, DOCS / "reproduction.md")
        for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1)
        if len(line) > 120 and not line.startswith(("|", "python3.11 -m venv"))
    ]
    assert long == []


def test_every_guide_has_a_picture_that_names_the_command_that_made_it() -> None:
    for page in GUIDES:
        text = page.read_text(encoding="utf-8")
        pictures = re.findall(r"^!\[[^\]]+\]\(([^)]+)\)\n\n\*(.*?)\*$", text, re.M | re.S)
        assert pictures, page.name
        for picture, caption in pictures:
            assert "Made" in caption, (page.name, picture)
            assert "by `" in " ".join(caption.split()), (page.name, picture)


def test_guides_contain_no_measurements() -> None:
    """A measurement carries the date or the commit at which it was made, and is evidence."""
    dated = re.compile(r"\b20\d\d-\d\d-\d\d\b|\b(?=[0-9a-f]*\d)(?=[0-9a-f]*[a-f])[0-9a-f]{7,8}\b")
    for page in GUIDES:
        assert dated.findall(page.read_text(encoding="utf-8")) == [], page.name


def fences(language: str) -> list[tuple[str, str]]:
    """Page and text of every fenced block of a language."""
    found = []
    for page in (*PAGES, ROOT / "README.md", ROOT / "examples" / "README.md"):
        for block in re.findall(
            rf"^ *```{language}\n(.*?)^ *```", page.read_text(encoding="utf-8"), re.M | re.S
        ):
            found.append((page.name, block))
    return found


def test_every_page_starts_with_something_to_do() -> None:
    """A command, a program or a numbered step stands within the first lines."""
    to_do = r" *```(sh|python|toml)|.*`(chaserdock|python|pip) |    (chaserdock|python) |1\. "
    for page in PAGES:
        lines = [line for line in page.read_text(encoding="utf-8").splitlines() if line][1:14]
        # The page of the reproduction is the output of a command.
        assert page.name == "reproduction.md" or any(re.match(to_do, line) for line in lines), (
            page.name
        )


@pytest.mark.parametrize("page", ["frames.md", "flight_scenario.md", "learning.md"])
def test_first_program_of_a_page_runs(page: str, capsys: pytest.CaptureFixture[str]) -> None:
    exec(next(block for name, block in fences("python") if name == page), {})
    assert capsys.readouterr().out


def test_scenarios_in_the_docs_are_right() -> None:
    """Every TOML example is TOML, and those that are a whole scenario, or sections of one, can be
    read as such.
    """
    base = tomllib.loads((ROOT / "scenarios" / "single.toml").read_text())
    read = 0
    for page, block in fences("toml"):
        values = tomllib.loads(block)
        if (
            page in ("tutorial.md", "howto-camera.md", "howto-body.md")
            and not {"vary", "seeds"} & values.keys()
        ):
            values.get("camera", {}).pop("calibration", None)
            thrusters = values.get("chaser", {}).pop("thrusters", None)
            if thrusters is not None:
                values["chaser"].pop("actuation")
            values.pop("extends", None)  # of a file only
            parse_scenario(base | values, page)
            read += 1
    assert read >= 4


def test_commands_in_the_docs_exist() -> None:
    """Every ``chaserdock COMMAND --option`` in a shell block is one that docs/cli.md, made from the
    program, has.
    """
    sections = re.split(r"^### ", (DOCS / "cli.md").read_text(encoding="utf-8"), flags=re.M)
    options = {
        s.partition("\n")[0]: set(re.findall(r"`(--?[a-z][a-z-]*)`", s)) for s in sections[1:]
    }
    tried = 0
    for page, block in fences("sh"):
        for command in re.findall(r"\bchaserdock ([a-z][^\n|&#;]*)", block.replace("\\\n", " ")):
            own = re.split(r"\s--\s", command)[0]
            words = own.split()
            verb = next((v for v in (" ".join(words[:2]), words[0]) if v in options), None)
            assert verb is not None, (page, command)
            used = set(re.findall(r"(?<=\s)(--?[a-z][a-z-]*)", own))
            assert used <= options[verb] | {"--help"}, (page, command, used - options[verb])
            tried += 1
    assert tried > 30
    verbs = {name.split()[0] for name in options}
    for page in WRITTEN:
        named = re.findall(r"`chaserdock ([a-z][a-z-]*)\b", page.read_text(encoding="utf-8"))
        assert set(named) <= verbs, page.name
