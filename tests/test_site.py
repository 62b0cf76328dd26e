"""The documentation site: it builds without warnings, asks for nothing from elsewhere, and can be read and searched."""

import functools
import http.server
import importlib.util
import re
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from browser import wait_for

from viapoint.envs import ENV_IDS

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("furo") is None, reason="the extra `docs` is not installed"
)
READ = (
    "index",
    "environments/PandaObstacles-v0",
    "results",
    "tutorials/ten-minutes",
    "api/viapoint.training.plan_motion",
    "project/changelog",
)
"""Pages that the browser opens: one of each kind."""
NARROW, WIDE = (400, 800), (1280, 900)
"""Sizes of the window, [pixels]."""
CONTRAST = 4.5
"""Least contrast of text, that of WCAG 2.1, level AA."""
BRIGHTNESS = """(() => {
  const light = colour => {
    const parts = colour.match(/[\\d.]+/g).slice(0, 3).map(value => value / 255);
    const linear = parts.map(c => c <= 0.03928 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2];
  };
  const ground = light(getComputedStyle(document.body).backgroundColor);
  const found = [...document.querySelectorAll('article p, article li, article td, article a, .sidebar-tree a')];
  return [ground, ...found.map(each => light(getComputedStyle(each).color))];
})()"""
"""Luminance of the background, and of the text of each paragraph, item, cell and link."""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site, built strictly from a copy of the pages."""
    folder = tmp_path_factory.mktemp("project")
    for name in ("pyproject.toml", "README.md", "CONTRIBUTING.md", "CHANGELOG.md"):
        shutil.copy(ROOT / name, folder)
    left = shutil.ignore_patterns("_build", "api", "project", "*Step-v0.md", "__pycache__")
    shutil.copytree(ROOT / "docs", folder / "docs", ignore=left)
    options = ["--fail-on-warning", "--keep-going", "--nitpicky", "--quiet"]
    command = [sys.executable, "-m", "sphinx", *options, str(folder / "docs"), str(folder / "html")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder / "html"


def test_no_page_asks_for_anything_from_elsewhere(site):
    loaded = re.compile(
        r"<(?:script|img|iframe|source)\b[^>]*\bsrc=\"([^\"]*)\"|<link\b[^>]*\bhref=\"([^\"]*)\""
    )
    for page in site.rglob("*.html"):
        for found in loaded.findall(page.read_text()):
            assert not re.match(r"(https?:)?//", "".join(found)), (page.name, found)
    fetched = re.compile(r"url\([\"']?(https?:)?//|@import [\"'](https?:)?//")
    for style in site.rglob("*.css"):
        assert not fetched.search(style.read_text()), style.name


def test_every_environment_has_a_page(site):
    pages = {page.stem for page in (site / "environments").glob("*.html")}
    assert {env_id.partition("/")[2] for env_id in ENV_IDS} <= pages


@pytest.fixture(scope="module")
def address(site):
    handler = functools.partial(Silent, directory=str(site))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_address[1]}"
    server.shutdown()
    server.server_close()


class Silent(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


@pytest.fixture
def tab(browser, address):
    """Open a page of the site in a window of a size, and wait for it."""
    tabs = []

    def opened(page, size=WIDE, scheme="light"):
        tab = browser.tab("about:blank")
        tabs.append(tab)
        width, height = size
        tab.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False
        )  # fmt: skip
        tab.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
        tab.call("Page.navigate", url=f"{address}/{page}")
        wait_for(lambda: tab.run("location.href !== 'about:blank' && document.readyState === 'complete'"))
        return tab

    yield opened
    for tab in tabs:
        tab.close()


@pytest.mark.parametrize("page", READ)
def test_a_page_can_be_read(page, tab, address):
    wide = tab(f"{page}.html")
    pictures = "[...document.images].filter(each => each.loading !== 'lazy')"
    assert wide.run(f"{pictures}.every(each => each.complete && each.naturalWidth > 0)")
    narrow = tab(f"{page}.html", NARROW)
    assert narrow.run("document.documentElement.scrollWidth") <= NARROW[0]
    for opened in (wide, narrow):
        assert opened.errors == []
        assert [url for url in opened.requests if not url.startswith((address, "data:", "about:"))] == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("page", ["index", "tutorials/ten-minutes", "api/viapoint.training.plan_motion"])
def test_text_stands_out_in_both_modes(page, scheme, tab):
    ground, *texts = tab(f"{page}.html", scheme=scheme).run(BRIGHTNESS)
    assert (ground < 0.2) == (scheme == "dark")
    for text in texts:
        assert (max(text, ground) + 0.05) / (min(text, ground) + 0.05) >= CONTRAST


@pytest.mark.parametrize(
    ("words", "page"), [("plan_motion", "plan_motion.html"), ("isochrony", "flash-hogan.html")]
)
def test_the_search_finds_pages(words, page, tab):
    results = tab(f"search.html?q={words}")
    links = "[...document.querySelectorAll('ul.search li a')].map(each => each.href.split('?')[0])"
    wait_for(lambda: any(link.endswith(page) for link in results.run(links)))
    assert results.errors == []
