"""The shape of the repository: who may import whom, what is installed, what the documents promise."""

import ast
import importlib
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from viapoint.training import cli

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
MAY_IMPORT = {
    "primitives": {"numpy", "array_api_compat", "viapoint.primitives"},
    "envs": {
        "numpy",
        "array_api_compat",
        "gymnasium",
        "mujoco",
        "glfw",
        "viapoint.primitives",
        "viapoint.envs",
    },
}
"""`glfw` comes with MuJoCo, which opens its windows with it."""
LONGEST_FILE, LONGEST_FUNCTION = 500, 60


def sources(folder):
    return sorted((ROOT / folder).rglob("*.py"))


def imported(path):
    """Modules that a file imports, relative imports made absolute."""
    folder = path.relative_to(ROOT).parent.parts
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(("viapoint", *folder[: len(folder) - node.level + 1])) if node.level else ""
            module = ".".join(part for part in (base, node.module) if part)
            yield from (
                [f"{module}.{alias.name}" for alias in node.names] if module == "viapoint" else [module]
            )


def top(module):
    parts = module.split(".")
    return ".".join(parts[:2]) if parts[0] == "viapoint" else parts[0]


@pytest.mark.parametrize("folder", MAY_IMPORT)
def test_imports_point_one_way(folder):
    for path in sources(folder):
        outside = (
            {top(module) for module in imported(path)} - MAY_IMPORT[folder] - set(sys.stdlib_module_names)
        )
        assert not outside, f"{path.relative_to(ROOT)} imports {outside}"


def test_what_training_imports_is_declared():
    declared = {
        re.split(r"[><=\[; ]", line)[0].lower().replace("-", "_")
        for lines in (
            PROJECT["project"]["dependencies"],
            *PROJECT["project"]["optional-dependencies"].values(),
        )
        for line in lines
    }
    for path in sources("training"):
        for name in {top(module) for module in imported(path)} - set(sys.stdlib_module_names):
            known = name.startswith("viapoint.") or name.lower() in declared
            assert known or name in ("PIL", "mpl_toolkits"), f"{path.name} imports {name}"  # with matplotlib


@pytest.mark.parametrize(
    ("module", "absent"),
    [
        ("viapoint.primitives", ("torch", "mujoco", "gymnasium", "scipy", "matplotlib")),
        ("viapoint.envs", ("torch", "stable_baselines3", "matplotlib", "scipy", "viapoint.training")),
        ("viapoint.training.entry", ("tyro", "rich", "tqdm", "numpy", "torch", "mujoco")),
        ("viapoint.training.cli", ("torch", "stable_baselines3", "matplotlib", "scipy")),
    ],
)
def test_importing_is_light(module, absent):
    script = f"import sys, {module}; print(*[name for name in {absent!r} if name in sys.modules])"
    loaded = subprocess.run([sys.executable, "-W", "error", "-c", script], capture_output=True, text=True)
    assert loaded.returncode == 0, loaded.stderr
    assert loaded.stdout.strip() == ""
    assert loaded.stderr == ""


def test_the_package_list_is_the_tree():
    listed = PROJECT["tool"]["setuptools"]["packages"]
    tree = {
        ".".join(("viapoint", *path.parent.relative_to(ROOT).parts))
        for folder in ("primitives", "envs", "training")
        for path in (ROOT / folder).rglob("__init__.py")
    }
    assert set(listed) == tree
    for path in (path for folder in ("primitives", "envs", "training") for path in sources(folder)):
        assert (path.parent / "__init__.py").exists(), f"{path} is in no package"


def test_the_console_script_exists():
    module, _, function = PROJECT["project"]["scripts"]["viapoint"].partition(":")
    assert callable(getattr(importlib.import_module(module), function))


def commands_in(text):
    """Command lines that begin with a name we own, as a reader would type them."""
    blocks = [block for _, block in re.findall(r"```(\w*)\n(.*?)```", text, flags=re.DOTALL)]
    inline = re.findall(r"`((?:viapoint|make) [^`\n]+)`", text)
    lines = [line.strip().removeprefix("$ ") for block in blocks for line in block.splitlines()] + inline
    return [line.partition("  #")[0].strip() for line in lines if re.match(r"(viapoint|make) ", line)]


def test_the_commands_of_the_readme_are_known(capsys):
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE))
    found = commands_in((ROOT / "README.md").read_text())
    assert any(line.startswith("viapoint train") for line in found)
    for line in found:
        program, *words = shlex.split(line, comments=True)
        if program == "make":
            assert {word for word in words if "=" not in word} <= targets, line
        elif "COMMAND" not in line:
            _understood(words, line)


def _understood(words, line):
    try:
        cli.parse(words)
    except SystemExit:
        return  # help was asked for
    except cli.UsageError as error:
        pytest.fail(f"{line}: {error}")


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_the_example_of_each_command_is_understood(name):
    document = cli.COMMANDS[name].config.__doc__
    example = re.search(r"Example: viapoint (.+)", document).group(1)
    assert example.split()[0] == name
    assert type(cli.parse(shlex.split(example))) is cli.COMMANDS[name].config


def test_files_and_functions_are_short():
    """Documentation does not count: an environment's page may be long, its code may not."""
    for path in (path for folder in ("primitives", "envs", "training") for path in sources(folder)):
        text = path.read_text()
        tree = ast.parse(text)
        documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
        nodes = [node for node in ast.walk(tree) if isinstance(node, documented)]
        lines = len(text.splitlines()) - sum(_document(node) for node in nodes)
        assert lines <= LONGEST_FILE, f"{path} has {lines} lines"
        for node in (node for node in nodes if isinstance(node, ast.FunctionDef)):
            length = node.end_lineno - node.lineno + 1 - _document(node)
            assert length <= LONGEST_FUNCTION, f"{path}: {node.name} has {length} lines"


def _document(node):
    """Lines of a node's documentation."""
    text = ast.get_docstring(node, clean=False)
    return 0 if text is None else text.count("\n") + 1
