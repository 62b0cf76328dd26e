"""The documentation site: it builds without warnings, asks for nothing from elsewhere, and can be read."""

import importlib.util
import re
import shutil
import subprocess
import sys
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


@pytest.mark.parametrize("page", READ)
def test_a_page_can_be_read(page, site, browser):
    """Also on a narrow screen."""
    folder = site.as_uri()
    tab = browser.tab(f"{folder}/{page}.html")
    wait_for(lambda: tab.run("location.href !== 'about:blank' && document.readyState === 'complete'"))
    pictures = "[...document.images].filter(each => each.loading !== 'lazy')"
    assert tab.run(f"{pictures}.every(each => each.complete && each.naturalWidth > 0)")
    tab.call("Emulation.setDeviceMetricsOverride", width=400, height=800, deviceScaleFactor=1, mobile=False)
    assert tab.run("document.documentElement.scrollWidth") <= 400
    assert tab.errors == []
    assert [url for url in tab.requests if not url.startswith((folder, "data:", "about:"))] == []
    tab.close()
