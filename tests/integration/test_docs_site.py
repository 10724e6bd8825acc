"""The documentation's site builds without a warning, shows what the Markdown says, and needs no network."""

import inspect
import os
import re
import subprocess
import sys
import typing
from html.parser import HTMLParser
from pathlib import Path

import pytest
from markdown_it import MarkdownIt

import featuredb
from tools.site_pages import PAGES, ROOT

_REFERENCE = "reference/python.md"  # of docstrings, not of Markdown alone
_SOURCES = {page: ROOT / source for source, page in PAGES.items()} | {
    path.relative_to(ROOT / "docs").as_posix(): path for path in (ROOT / "docs").rglob("*.md")
}
del _SOURCES[_REFERENCE]
_COUNTED = ("table", "tr", "li", "pre", "img", "h1", "h2", "h3")


class _Page(HTMLParser):
    """Counts elements of a page's article, and what the page loads from elsewhere."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.counts = dict.fromkeys(_COUNTED, 0)
        self.loaded: list[str] = []
        self._inside = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        if tag == "article":
            self._inside = True
        if self._inside and tag in self.counts:
            self.counts[tag] += 1
        source = values.get("src") if tag != "link" else values.get("href")
        if source and source.startswith(("http:", "https:", "//")):
            self.loaded.append(source)

    def handle_endtag(self, tag: str) -> None:
        self._inside = self._inside and tag != "article"


def build(config: Path, out: Path) -> "subprocess.CompletedProcess[str]":
    # Not --quiet: it silences the warnings before --strict counts them.
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-f", str(config), "-d", str(out)]
    quiet = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    return subprocess.run(command, env=quiet, capture_output=True, text=True, check=False, timeout=120)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built as `mkdocs build --strict` builds it."""
    out = tmp_path_factory.mktemp("site")
    done = build(ROOT / "mkdocs.yml", out)
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    return out


def html_of(page: str) -> str:
    folder, _, name = page.rpartition("/")
    return f"{folder}/index.html".lstrip("/") if name == "README.md" else page.replace(".md", ".html")


@pytest.mark.parametrize("page", sorted(_SOURCES))
def test_a_page_shows_the_tables_lists_and_code_of_its_markdown(site: Path, page: str) -> None:
    # Python-Markdown and GitHub read lists and tables that follow a line of text in different ways.
    markdown = MarkdownIt("commonmark").enable("table").render(_SOURCES[page].read_text(encoding="utf-8"))
    expected = _Page(f"<article>{markdown}</article>").counts
    assert _Page((site / html_of(page)).read_text(encoding="utf-8")).counts == expected


def test_the_site_loads_nothing_from_elsewhere(site: Path) -> None:
    pages = [_Page(path.read_text(encoding="utf-8")) for path in site.rglob("*.html")]
    assert len(pages) > len(_SOURCES)  # and the page for what is not found
    assert [source for page in pages for source in page.loaded] == []
    assert (site / "search" / "search_index.json").is_file()


def _members(owner: type) -> dict[str, object]:
    """Public methods and properties of a class by their full names."""
    of_methods = (property, classmethod, staticmethod)
    return {
        f"{owner.__module__}.{owner.__qualname__}.{name}": value
        for name, value in vars(owner).items()
        if not name.startswith("_") and (inspect.isfunction(value) or isinstance(value, of_methods))
    }


def test_the_reference_has_every_public_name_and_what_its_methods_give(site: Path) -> None:
    assert dir(featuredb) == sorted(featuredb.__all__)
    names: dict[str, object] = {"featuredb.open": featuredb.open}
    classes = {v for v in (getattr(featuredb, n) for n in featuredb.__all__) if inspect.isclass(v)}
    for value in _members(featuredb.FeatureDatabase).values():
        given = typing.get_type_hints(value.fget if isinstance(value, property) else value)["return"]
        if given.__module__ != "builtins":
            classes.add(given)
    assert len(classes) > 8  # found, and not only named
    for owner in classes:
        names |= {f"{owner.__module__}.{owner.__qualname__}": owner} | _members(owner)
    page = (site / html_of(_REFERENCE)).read_text(encoding="utf-8")
    shown = set(re.findall(r'id="([\w.]+)"', page))
    assert sorted(names.keys() - shown) == []
    # A dataclass without a docstring is given its signature.
    bare = [
        name for name, v in names.items() if not v.__doc__ or v.__doc__.startswith(f"{name.split('.')[-1]}(")
    ]
    assert bare == []
    assert "featuredb.__version__</code>" in page


def test_what_leads_nowhere_stops_the_build(tmp_path: Path) -> None:
    wrong = {
        "[gone](gone.md)": "'gone.md'",
        "[gone](wire.md#gone)": "'#gone'",
        "![gone](figures/gone.png)": "'figures/gone.png'",
    }
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "index.md").write_text("\n\n".join(["# Start", *wrong]) + "\n")
    (tmp_path / "docs" / "wire.md").write_text("# The wire\n")
    (tmp_path / "docs" / "alone.md").write_text("# Not in the navigation\n")
    plain = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").split("\nnav:")[0]
    plain = "\n".join(
        line for line in plain.splitlines() if "hooks:" not in line and "site_pages" not in line
    )
    (tmp_path / "mkdocs.yml").write_text(f"{plain}\nnav: [index.md, wire.md]\n")
    done = build(tmp_path / "mkdocs.yml", tmp_path / "site")
    assert done.returncode == 1
    # Strict mode counts warnings; that each is one is seen by what it says.
    assert done.stderr.count("WARNING") == len(wrong) + 1
    assert 'not included in the "nav"' in done.stderr
    assert [warning for warning in wrong.values() if warning not in done.stderr] == []
