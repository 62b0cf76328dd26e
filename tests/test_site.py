"""The documentation site builds without warnings and asks for nothing from elsewhere."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LOADED = re.compile(r"<(?:script|img|iframe|source)\b[^>]*\bsrc=\"([^\"]*)\"|<link\b[^>]*\bhref=\"([^\"]*)\"")
"""What a page loads."""
LOADED_BY_STYLES = re.compile(r"url\([\"']?(https?:)?//|@import [\"'](https?:)?//")


def test_the_site_is_built_strictly_and_asks_for_nothing_from_elsewhere(tmp_path):
    pytest.importorskip("furo")
    for name in ("pyproject.toml", "README.md", "CONTRIBUTING.md", "CHANGELOG.md"):
        shutil.copy(ROOT / name, tmp_path)
    left = shutil.ignore_patterns("_build", "api", "project", "*Step-v0.md", "__pycache__")
    shutil.copytree(ROOT / "docs", tmp_path / "docs", ignore=left)
    options = ["--fail-on-warning", "--keep-going", "--nitpicky", "--quiet"]
    command = [sys.executable, "-m", "sphinx", *options, str(tmp_path / "docs"), str(tmp_path / "html")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for page in tmp_path.glob("html/**/*.html"):
        for found in LOADED.findall(page.read_text()):
            assert not re.match(r"(https?:)?//", "".join(found)), (page.name, found)
    for style in tmp_path.glob("html/**/*.css"):
        assert not LOADED_BY_STYLES.search(style.read_text()), style.name
