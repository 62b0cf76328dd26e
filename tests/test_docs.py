"""Pages and code agree: links, examples, tutorials and commands; docstrings begin with whole sentences."""

import ast
import contextlib
import doctest
import enum
import inspect
import json
import multiprocessing
import re
import shlex
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import notebooks
import pytest

from viapoint import envs, primitives, training
from viapoint.training import configs
from viapoint.training.cli import entry as cli

ROOT = Path(__file__).parents[1]
WRITTEN = [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")]
PAGES = {path.relative_to(ROOT).as_posix(): path for path in WRITTEN if "Step-" not in path.name}
"""Pages that were written by hand; the site has generated ones, too."""
PUBLIC = ("viapoint.primitives", "viapoint.envs", "viapoint.training")
OWN_TESTS = {"docs/bring-your-arm.md", "docs/datasets.md", "docs/live.md", "docs/studies.md"}
"""Pages whose examples train for long or need files; tests of their subject run them."""
PRELOADED = ["gymnasium", "matplotlib.pyplot", "mujoco", "numba", "pandas", "scipy.optimize"]
PRELOADED += ["stable_baselines3"]
"""Modules that take long to import; not Viapoint, whose import registers what an example may lack."""
SHORTER = {
    "learn(1_000)": "learn(128)",
    "BUDGET = 1_000": "BUDGET = 128",
    "n_timesteps=256": "n_timesteps=64",
    "n_scenes=100": "n_scenes=10",
    'eval_scenes\\": 50': 'eval_scenes\\": 10',
}
"""Numbers with which examples are as good, and faster."""
every_page = pytest.mark.parametrize("name", sorted(PAGES))


def text(name):
    return PAGES[name].read_text(encoding="utf-8")


def examples(name):
    return re.findall(r"```python\n(.*?)```", text(name), re.DOTALL)


def shorter(script):
    for usual, less in SHORTER.items():
        script = script.replace(usual, less)
    return script


def prose(name):
    return re.sub(r"```.*?```", "", text(name), flags=re.DOTALL)


def anchors(name):
    """Anchors of the headings of a page, as GitHub makes them."""
    heads = re.findall(r"^#+ (.*)$", prose(name), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@every_page
def test_links_lead_somewhere(name):
    for link in re.findall(r"\]\(([^)\s]+)\)", prose(name)):
        file, _, anchor = link.partition("#")
        if file.startswith(("https:", "http:")):
            continue
        target = (PAGES[name].parent / file).resolve() if file else PAGES[name]
        assert target.exists(), link
        assert not anchor or anchor in anchors(target.relative_to(ROOT).as_posix()), link


@pytest.fixture(scope="module")
def in_a_new_process():
    """Function that calls a function in a process of its own, which has imported what takes long to import."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)

    def call(function, *arguments):
        with ProcessPoolExecutor(1, mp_context=context) as process:
            return process.submit(function, *arguments).result()

    with pytest.MonkeyPatch.context() as patch, contextlib.chdir(ROOT):
        patch.setenv("OMP_NUM_THREADS", "1")  # threads of several pages wait for one another
        yield call


@every_page
def test_examples_run(name, in_a_new_process):
    """Each page runs in a process of its own, as some examples register arms, tasks and families."""
    script = shorter("\n".join(examples(name)))
    for module in re.findall(r"^\s*(?:from|import) (viapoint[\w.]*)", script, re.MULTILINE):
        assert module in PUBLIC, module
    if script and name not in OWN_TESTS:
        in_a_new_process(exec, script, {"__name__": "__main__"})


def test_the_readme_shows_what_its_first_example_prints(in_a_new_process):
    first, *_ = examples("README.md")
    printed = re.search(r"```text\n(.*?)```", text("README.md"), re.DOTALL)[1]
    (output,) = in_a_new_process(notebooks.executed, first, {"__name__": "__main__"}, "README.md")
    check_printed("".join(output["text"]), printed)


@pytest.mark.parametrize("name", ["README.md", "docs/fit.md"])
def test_pages_show_what_fit_prints(name, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(ROOT)
    line, printed = re.search(r"\$ viapoint (fit .*)\n([^`]*)```", text(name)).groups()
    cli.main([*shlex.split(line), "--out", str(tmp_path)])
    check_printed(capsys.readouterr().out.partition("\n\n")[0], printed)


def check_printed(text, stored):
    """Check that words are equal, and numbers about so: the last digits of another processor change what is found."""
    number = r"-?\d+(?:\.\d*)?"
    text, stored = (re.sub(f"(milliseconds|seeds)={number}", "", each) for each in (text, stored))
    assert re.sub(number, "#", text).split() == re.sub(number, "#", stored).split()
    numbers = [[float(each) for each in re.findall(number, part)] for part in (text, stored)]
    assert numbers[0] == pytest.approx(numbers[1], rel=0.25, abs=0.02)


def commands(name):
    """Command lines of `viapoint` and `make` on a page, as a reader would type them."""
    blocks = re.findall(r"```\w*\n(.*?)```", text(name), re.DOTALL)
    lines = [line.strip().removeprefix("$ ") for block in blocks for line in block.splitlines()]
    lines += re.findall(r"`((?:viapoint|make) [^`\n]+)`", text(name))
    return [line for line in lines if re.match(r"(viapoint|make) ", line)]


@pytest.mark.parametrize("name", sorted(set(PAGES) - {"CHANGELOG.md"}))  # which names what is gone, too
def test_commands_are_known(name):
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for line in commands(name):
        program, *words = shlex.split(line, comments=True)
        if program == "make":
            assert {word for word in words if "=" not in word} <= targets, line
        elif len(words) > 1 and "COMMAND" not in line:
            with contextlib.suppress(SystemExit):  # help is asked for
                cli.parse(words)


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_the_example_of_each_command_is_understood(name):
    config = getattr(configs, f"{name.capitalize()}Config")
    example = re.search(r"Example: (?:.*; )?viapoint (.+)", config.__doc__).group(1)
    assert type(cli.parse(shlex.split(example))) is config


@pytest.mark.parametrize("path", sorted(ROOT.glob("docs/tutorials/*.ipynb")), ids=lambda path: path.stem)
def test_a_tutorial_runs(path, in_a_new_process, tmp_path):
    written = path.read_text(encoding="utf-8")
    if shorter(written) != written:  # others read files beside them
        path = tmp_path / path.name
        path.write_text(shorter(written), encoding="utf-8")
    stored = json.loads(written)["cells"]
    same = True
    for cell, again in zip(stored, in_a_new_process(notebooks.run, path), strict=True):
        outputs, others = cell.get("outputs", []), again.get("outputs", [])
        assert [each["output_type"] for each in outputs] == [each["output_type"] for each in others]
        same &= cell["source"] == again["source"]  # what follows a shorter cell prints other numbers
        if same:
            for output, other in zip(outputs, others, strict=True):
                check_printed("".join(other.get("text", ())), "".join(output.get("text", ())))


FRAGMENT = re.compile(
    r"(What|Of|How|Whether|That|Where|They|It|As|The same|Who|Whose|Which|Why|By|Those|Both|Also|For|From|With|In|"
    r"Let)\b"
)
"""Beginnings of sentences that depend on something outside the docstring."""
FOLDERS = ("primitives", "envs", "training", "benchmarks", "docs")
FILES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))


def docstrings(tree):
    """Yield line and text of the docstrings of modules, classes, functions, attributes and constants."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        for before, statement in zip([None, *node.body], node.body, strict=False):
            value = getattr(statement, "value", None)
            is_text = isinstance(statement, ast.Expr) and isinstance(getattr(value, "value", None), str)
            if is_text and (before is None or isinstance(before, ast.Assign | ast.AnnAssign)):
                yield statement.lineno, value.value.strip()


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_docstrings_begin_with_a_whole_sentence(path):
    found = docstrings(ast.parse(path.read_text()))
    assert [each for each in found if FRAGMENT.match(each[1])] == []


EXPORTS = [(package, name) for package in (primitives, envs, training) for name in package.__all__]


@pytest.mark.parametrize(("package", "name"), EXPORTS)
def test_examples_of_docstrings_run(package, name, monkeypatch):
    monkeypatch.chdir(ROOT)
    try:
        value = getattr(package, name)
    except ImportError:
        pytest.skip(f"{name} needs an extra")
    if name == "run_study":
        return  # tests/training/test_study.py runs it, where a Ray is there
    value = type(value) if isinstance(value, enum.Enum) else value
    if not (inspect.isclass(value) or inspect.isfunction(value)):
        return
    tests = doctest.DocTestFinder().find(value, name, globs={})
    assert any(test.examples for test in tests), f"{name} has no example"
    for test in tests:
        report = []
        assert not doctest.DocTestRunner().run(test, out=report.append).failed, "".join(report)
