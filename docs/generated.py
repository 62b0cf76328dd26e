"""Generated parts of the documentation site: pages of environments and of exported names, and lists of pages."""

from __future__ import annotations

import importlib
import inspect
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from sphinx.pycode import ModuleAnalyzer

from viapoint.envs import TASKS, Task

ROOT = Path(__file__).parents[1]
PACKAGES = ("viapoint.primitives", "viapoint.envs", "viapoint.training")
EXPORTS = {name: package for package in PACKAGES for name in importlib.import_module(package).__all__}
"""Package of each exported name."""
NAMES = {name.lower(): name for name in (re.sub(r".*/|-v0", "", env_id) for env_id in TASKS)}
"""Names of the tasks without version, by their lower-case forms in references."""
ROOT_PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "project/contributing.md",
    "CHANGELOG.md": "project/changelog.md",
}
"""Pages of the site that files in the root are copied to."""
TASK_PAGE = "tasks.md"
"""Page with a section on each task, which becomes a page of its own."""


def write_pages(docs: Path) -> None:
    """Write the pages that are generated as a whole into the folder of the documentation."""
    for name, page in ROOT_PAGES.items():
        if page.startswith("project/"):
            text = (ROOT / name).read_text(encoding="utf-8")
            text = re.sub(r"\]\((?!https?:|#|docs/)", "](../../", text).replace("](docs/", "](../")
            write(docs / page, text)
    for name, text in task_pages((docs / TASK_PAGE).read_text(encoding="utf-8")).items():
        write(docs / "environments" / f"{name}.md", f"{text}\n{head(name)}")
    for package in PACKAGES:
        module = importlib.import_module(package)
        write(docs / "api" / f"{package}.rst", package_page(package))
        for name in module.__all__:
            write(docs / "api" / f"{package}.{name}.rst", name_page(package, name))


def write(path: Path, text: str) -> None:
    """Write a file, unless it has this text already, so that only pages that changed are built again."""
    path.parent.mkdir(exist_ok=True)
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def package_page(package: str) -> str:
    """Return the page of a package: its docstring, and its names with a sentence on each."""
    module = importlib.import_module(package)
    rows = [
        f"   * - :py:obj:`~{package}.{name}`\n     - {summary(package, name)}\n" for name in module.__all__
    ]
    names = "".join(f"   {package}.{name}\n" for name in module.__all__)
    table = f".. list-table::\n   :widths: 30 70\n\n{''.join(rows)}"
    listed = f".. toctree::\n   :hidden:\n\n{names}"
    return f"{title(package)}.. automodule:: {package}\n   :no-members:\n\n{table}\n{listed}"


def name_page(package: str, name: str) -> str:
    """Return the page of an exported name."""
    value = getattr(importlib.import_module(package), name)
    if not callable(value):
        sentence = summary(package, name).replace("\n", " ")
        return f"{title(name)}.. py:data:: {package}.{name}\n\n   {sentence}\n"
    kind = "class" if inspect.isclass(value) else "function"
    return f"{title(name)}.. currentmodule:: {package}\n\n.. auto{kind}:: {package}.{name}\n"


def summary(package: str, name: str) -> str:
    """Return the first sentence of the docstring of an exported name."""
    value = getattr(importlib.import_module(package), name)
    text = inspect.getdoc(value) if callable(value) else constant_docstring(package, name)
    return escaped(" ".join((text or "").partition("\n\n")[0].split()))


def constant_docstring(package: str, name: str) -> str:
    """Return the text below the assignment of a constant in one of the modules of a package."""
    for module in [each for each in sys.modules if each.startswith(f"{package}.")]:
        found = ModuleAnalyzer.for_module(module).find_attr_docs().get(("", name))
        if found:
            return "\n".join(found)
    return ""


def escaped(text: str) -> str:
    """Return a line of a docstring in which |x| is no reference of reStructuredText."""
    return text if ">>>" in text else text.replace("|", "\\|")


def title(text: str) -> str:
    """Return a heading of reStructuredText."""
    return f"{text}\n{'=' * len(text)}\n\n"


def task_pages(text: str) -> dict[str, str]:
    """Return the text on each task from those of their sections; twins have the picture of the other task."""
    text = re.sub(r"\]\(#(\w+)-v0\)", lambda found: f"](../environments/{NAMES[found[1]]}-v0.md)", text)
    text = re.sub(r"\]\((?!https?:|\.\./)", "](../", text)
    sections = dict(part.split("\n", 1) for part in text.split("\n## ")[1:])
    found = {name: f"# {name}\n{section}" for name, section in sections.items()}
    for name in NAMES.values():
        twin = name.replace("Step", "")
        if name == twin:
            continue
        picture = re.findall(r"(?m)^!\[.*$", sections[f"{twin}-v0"])[:1]
        found[f"{name}-v0"] = (
            f"# {name}-v0\n\nThe task of [{twin}-v0]({twin}-v0.md) with an action in every control step: a velocity of "
            f"the hand or of the joints ([actions](../environments.md#actions)).\n\n{''.join(picture)}\n"
        )
    return found


def head(name: str) -> str:
    """Return a call of an environment, its spaces, and the values of its arguments."""
    env_id = f"viapoint/{name}"
    task = Task.of(**TASKS[env_id])
    size = len(task.action_names)
    keys = "\n".join(f"| `{key}` | {box.shape[0]} |" for key, box in task.observation.space().items())
    given = ", ".join(f"`{key}={value!r}`" for key, value in TASKS[env_id].items()) or "none"
    apart = {"reward_weights"} | (
        {"whole_arm"} if task.space_name == "joints" else set()
    )  # all of an arm in space
    values = {key: value for key, value in task.as_dict().items() if key not in apart}
    weights = ", ".join(f"{key} {value:g}" for key, value in task.as_dict()["reward_weights"].items())
    defaults = "\n".join(f"| `{key}` | {plain(value)} |" for key, value in values.items())
    return f"""```python
import gymnasium as gym

env = gym.make("viapoint.envs:{env_id}")
envs = gym.make_vec("viapoint.envs:{env_id}", num_envs=64)
```

**Action space:** `Box(-1.0, 1.0, ({size},), float32)`; components {plain(task.action_names)}

**Observation space:** `Dict` of `float32` boxes

| key | size |
|---|---:|
{keys}

**Arguments that differ from the defaults of the class:** {given}

| argument | value |
|---|---|
{defaults}
| `reward_weights` | {weights} |
"""


def plain(value: object) -> str:
    """Return a value as a cell of a table."""
    if isinstance(value, list | tuple):
        return ", ".join(f"`{each}`" if isinstance(each, str) else f"{each:g}" for each in value) or "-"
    return f"`{value}`" if isinstance(value, str) else str(value)


def with_contents(text: str) -> str:
    """Return the first page with a hidden list of the pages that each of its sections links to."""
    parts = re.split(r"(?m)^(?=## )", text)
    done = [parts[0]]
    for part in parts[1:]:
        caption = part.splitlines()[0].removeprefix("## ")
        pages = re.findall(r"\]\(((?:\.\./)?[\w/.-]+\.(?:md|ipynb))\)", part)
        pages = [ROOT_PAGES.get(page.removeprefix("../"), page) for page in pages]
        if caption == "API reference":
            pages += [f"api/{package}.rst" for package in PACKAGES]
        done.append(f"{part.rstrip()}\n\n{contents(pages, caption)}\n" if pages else part)
    return "".join(done)


def contents(pages: Sequence[str], caption: str = "", glob: bool = False) -> str:
    """Return a hidden list of pages, for the side bar."""
    listed = "\n".join(dict.fromkeys(re.sub(r"\.(md|rst|ipynb)$", "", page) for page in pages))
    options = (f":caption: {caption}\n" if caption else "") + (":glob:\n" if glob else "")
    return f"```{{toctree}}\n:hidden:\n{options}\n{listed}\n```\n"
