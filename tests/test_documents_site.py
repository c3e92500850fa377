"""The site of documents is built without a warning, is complete, and works without a server and a network."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from html import unescape
from pathlib import Path
from urllib.parse import unquote

import pytest

import livessl
from browser import faultless_page, running_browser, visit

ROOT = Path(__file__).parents[1]
HOOK = ROOT / "scripts" / "site" / "pages.py"
ASSETS = ("script", "link", "img", "iframe", "source")
ELSEWHERE = re.compile(r"[a-z][a-z0-9+.-]*:|//")
ELEMENT = re.compile(r"<([a-z][a-z0-9]*)\s([^>]*)>")
ATTRIBUTE = re.compile(r"""(?<![\w-])(href|src|id)=["']?([^"'\s>]*)""")
LOADED_STYLE = re.compile(r"""(?:url\(|@import\s+)\s*["']?(?:https?:)?//""")


def build(config: Path, into: Path) -> subprocess.CompletedProcess[str]:
    command = [
        sys.executable,
        "-m",
        "mkdocs",
        "build",
        "--strict",
        "--config-file",
        str(config),
        "--site-dir",
        str(into),
    ]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)


@dataclass
class HTMLPage:
    """The ids of a page, and the addresses that its elements name: (element, address)."""

    ids: set[str]
    addresses: list[tuple[str, str]]

    @classmethod
    def read(cls, path: Path) -> HTMLPage:
        text = path.read_text(encoding="utf-8")
        ids, addresses = set(), []
        for element, attributes in ELEMENT.findall(text):
            for name, value in ATTRIBUTE.findall(attributes):
                if name == "id":
                    ids.add(unescape(value))
                elif value:
                    addresses.append((element, unescape(value)))
        return cls(ids, addresses)


@dataclass
class Site:
    """A built site: its folder, what the build said, and its pages."""

    folder: Path
    done: subprocess.CompletedProcess[str]
    pages: dict[Path, HTMLPage]

    def html(self, name: str) -> str:
        return (self.folder / name).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    folder = tmp_path_factory.mktemp("site")
    done = build(ROOT / "mkdocs.yml", folder)
    return Site(folder, done, {path: HTMLPage.read(path) for path in folder.rglob("*.html")})


def test_the_site_is_built_without_warnings(site: Site) -> None:
    assert site.done.returncode == 0, site.done.stderr


def test_every_document_is_a_page_of_the_site(site: Site) -> None:
    documents = [path.relative_to(ROOT / "docs") for path in (ROOT / "docs").rglob("*.md")]
    expected = {
        path.with_name("index.html") if path.name == "README.md" else path.with_suffix(".html") for path in documents
    }
    outside = ("overview", "contributing", "changelog", "deploy/index", "examples/index", "config/index")
    expected |= {Path(f"{name}.html") for name in outside}
    assert len(expected) > 120
    assert expected - {path.relative_to(site.folder) for path in site.pages} == set()


def test_every_page_but_a_decision_is_linked_from_the_first_page(site: Site) -> None:
    start = site.pages[site.folder / "index.html"]
    linked = {(site.folder / address.partition("#")[0]).resolve() for tag, address in start.addresses if tag == "a"}
    by_their_lists = ("decisions", "config", "calibration", "examples")
    pages = {path for path in site.pages if path.relative_to(site.folder).parts[0] not in (*by_their_lists, "404.html")}
    assert pages - linked == set()
    assert site.folder / "decisions" / "index.html" in linked


def test_the_reference_has_every_name(site: Site) -> None:
    ids = {name for page in site.pages.values() for name in page.ids}
    listed = {name.rpartition(".")[2] for name in ids if name.startswith("livessl.")}
    assert set(livessl.__all__) - {"METHODS", "__version__"} <= listed


def test_the_site_loads_nothing_from_elsewhere(site: Site) -> None:
    loaded = [
        f"{path.name}: {address}"
        for path, page in site.pages.items()
        for tag, address in page.addresses
        if tag in ASSETS and ELSEWHERE.match(address) and not address.startswith("data:")
    ]
    assert loaded == []
    styles = list(site.folder.rglob("*.css"))
    assert styles
    assert [path.name for path in styles if LOADED_STYLE.search(path.read_text(encoding="utf-8"))] == []


def broken(site: Site) -> Iterator[str]:
    """Yield each link within the site that leads to no file or to no place on its page."""
    for path, page in site.pages.items():
        if path.name == "404.html":  # its addresses are those of a server
            continue
        for _, address in page.addresses:
            if ELSEWHERE.match(address):
                continue
            name, _, anchor = unquote(address).partition("#")
            target = (path.parent / name.partition("?")[0]).resolve() if name else path
            target = target / "index.html" if target.is_dir() else target
            known = site.pages.get(target)
            if not target.exists() or (anchor and known and anchor not in known.ids):
                yield f"{path.relative_to(site.folder)}: {address}"


def test_every_link_within_the_site_leads_somewhere(site: Site) -> None:
    assert sum(len(page.addresses) for page in site.pages.values()) > 10_000
    assert list(broken(site)) == []


def test_files_to_start_from_can_be_downloaded_and_raw_results_are_left_out(site: Site) -> None:
    for name in ("config/umc1820.yaml", "calibration/tetrahedron-0.5m.svg", "deploy/compose.yaml", "examples/tour.py"):
        assert (site.folder / name).read_bytes() == (ROOT / name).read_bytes()
    assert 'href="config/umc1820.yaml"' in site.html("hardware.html")
    assert [path for ending in ("parquet", "jsonl", "csv") for path in site.folder.rglob(f"*.{ending}")] == []


@pytest.mark.browser
def test_the_search_works_in_pages_that_are_opened_as_files(site: Site) -> None:
    with running_browser() as browser, faultless_page(browser) as page:
        requested: list[str] = []
        page.on("request", lambda request: requested.append(request.url))
        visit(page, (site.folder / "zones.html").as_uri())
        page.locator("input.md-search__input").press_sequentially("tetrahedron")
        results = page.locator(".md-search-result__item")
        results.first.wait_for()
        assert "tetrahedron" in results.first.inner_text().lower()
        assert [url for url in requested if not url.startswith("file:")] == []


PAGE = """# Page

Text with no empty line before the list:
- one, with [a page](../CONTRIBUTING.md#tests), [a file](../LICENSE) and [source](../pyproject.toml)
- two

1. First:

   ```sh
   true
   ```

2. Second, which [leads nowhere](../missing.md).
"""


def test_pages_are_read_as_in_a_checkout_and_a_link_to_nothing_fails_the_build(tmp_path: Path) -> None:
    pages = tmp_path / "docs"
    pages.mkdir()
    (pages / "index.md").write_text(PAGE, encoding="utf-8")
    config = tmp_path / "mkdocs.yml"
    config.write_text(
        f"site_name: small\ndocs_dir: {pages}\nuse_directory_urls: false\nplugins: []\ntheme: {{name: mkdocs}}\n"
        f"markdown_extensions: [sane_lists, pymdownx.superfences]\nhooks: ['{HOOK}']\n",
        encoding="utf-8",
    )
    done = build(config, tmp_path / "built")
    assert done.returncode != 0
    assert "'index.md' contains a link '../missing.md'" in done.stderr
    html = (tmp_path / "built" / "index.html").read_text(encoding="utf-8")
    assert "<li>one, with " in html
    assert 'href="contributing.html#tests">a page</a>' in html
    assert 'href="LICENSE.txt">a file</a>' in html
    assert "<span>source</span>" in html
    assert html.count("<ol") == 1
