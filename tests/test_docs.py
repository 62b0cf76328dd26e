"""Pages of the documentation: links, imports and examples."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
NAMES = [str(path.relative_to(ROOT)) for path in PAGES]
PUBLIC = ("viapoint.primitives", "viapoint.envs", "viapoint.training")


def examples(path):
    return re.findall(r"```python\n(.*?)```", path.read_text(encoding="utf-8"), re.DOTALL)


def anchors(path):
    """Anchors of the headings of a page, as GitHub makes them."""
    prose = re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
    heads = re.findall(r"^#+ (.*)$", prose, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.mark.parametrize("path", PAGES, ids=NAMES)
def test_links_lead_somewhere(path):
    prose = re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
    for link in re.findall(r"\]\(([^)\s]+)\)", prose):
        if link.startswith(("https://", "http://")):
            continue
        file, _, anchor = link.partition("#")
        target = (path.parent / file).resolve() if file else path
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


def test_files_named_to_contributors_hold_what_they_are_named_for():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    table = text.split("## Where things are")[1].split("##")[0]
    for files in re.findall(r"`(\w+/[\w/]+\.py)`", text):
        assert (ROOT / files).is_file() or "NAME" in files, files
    for row in table.splitlines()[4:]:
        for names, file in re.findall(r"((?:`\w+`(?: and )?)+) in `([\w/]+\.py)`", row):
            source = (ROOT / file).read_text(encoding="utf-8")
            for name in re.findall(r"\w+", names.replace(" and ", " ")):
                assert re.search(rf"(?:class|def) {name}\b", source), (name, file)


@pytest.mark.parametrize("path", PAGES, ids=NAMES)
def test_examples_import_public_packages_only(path):
    for example in examples(path):
        for module in re.findall(r"^\s*(?:from|import) (viapoint[\w.]*)", example, re.MULTILINE):
            assert module in PUBLIC, module


def test_the_index_lists_every_page():
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    for path in (ROOT / "docs").glob("*.md"):
        assert path.name == "index.md" or f"]({path.name}" in index, path.name


@pytest.mark.parametrize(
    "name",
    ["CONTRIBUTING.md", "docs/baselines.md", "docs/choosing.md", "docs/geometry.md", "docs/studies.md"],
)
def test_the_examples_of_a_page_run(name):
    """Each page runs in a process of its own, as some examples register arms, tasks and families."""
    script = "\n".join(examples(ROOT / name))
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
