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

from viapoint.training.cli import main as cli

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
MAY_IMPORT = {
    "primitives": {"numpy", "array_api_compat", "viapoint.primitives"},
    "envs": {
        "numpy",
        "array_api_compat",
        "gymnasium",
        "mujoco",
        "scipy",
        "glfw",
        "viapoint.primitives",
        "viapoint.envs",
    },
}
"""`glfw` comes with MuJoCo, which opens its windows with it."""
LONGEST_FILE, LONGEST_FUNCTION, LONGEST_CHAIN, MOST_MODULES = 500, 60, 20, 15
"""Imports for type checkers do not count; eight modules of the longest are arms and geometry, and three studies."""


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


def modules():
    """Our modules, by name, with their files."""
    found = {}
    for path in (path for folder in ("primitives", "envs", "training") for path in sources(folder)):
        parts = path.relative_to(ROOT).with_suffix("").parts
        found[".".join(("viapoint", *(parts[:-1] if parts[-1] == "__init__" else parts)))] = path
    return found


def import_graph(*, strings=True, typing=True):
    """Modules of ours that each module imports, deferred imports and those for types included.

    With `strings`, a string that names a module counts, too: registries load these modules later. Without `typing`,
    imports for type checkers alone do not count.
    """
    known = modules()
    graph = {}
    for name, path in known.items():
        package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        tree = ast.parse(path.read_text())
        seen = set()
        skipped = set() if typing else typing_only(tree)
        for node in ast.walk(tree):
            if node in skipped:
                continue
            if isinstance(node, ast.Import):
                seen |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                parents = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
                base = ".".join((*parents, *([node.module] if node.module else [])))
                members = {f"{base}.{alias.name}" for alias in node.names}
                seen |= (members & known.keys()) | ({base} if members - known.keys() else set())
            elif strings and isinstance(node, ast.Constant) and isinstance(node.value, str):
                named = node.value.partition(":")[0]
                seen |= {named} if named in known and known[named].name != "__init__.py" else set()
        graph[name] = (seen & known.keys()) - {name}
    return graph


def typing_only(tree):
    """Imports under `if TYPE_CHECKING`."""
    blocks = [node for node in ast.walk(tree) if isinstance(node, ast.If)]
    return {
        each
        for block in blocks
        if isinstance(block.test, ast.Name) and block.test.id == "TYPE_CHECKING"
        for each in block.body
    }


def package_of(module, known):
    """The sub-package that a module belongs to; the modules beside the sub-packages are one of their own."""
    parts = module.split(".")
    inner = ".".join(parts[:3])
    is_package = len(parts) > 2 and known[inner].name == "__init__.py"
    return inner if is_package and parts[1] != "primitives" else ".".join(parts[:2])


def without_importers(graph):
    """What is left of a graph when all that lies on no cycle is gone."""
    left = {name: set(targets) for name, targets in graph.items()}
    while free := [name for name, targets in left.items() if not targets & left.keys()]:
        for name in free:
            del left[name]
    return left


def test_modules_import_one_another_without_cycles():
    graph = import_graph()
    graph = {
        name: {each for each in targets if not name.startswith(f"{each}.")} for name, targets in graph.items()
    }
    assert without_importers(graph) == {}


def test_sub_packages_import_one_another_without_cycles():
    known, packages = modules(), {}
    for module, targets in import_graph().items():
        package = package_of(module, known)
        packages.setdefault(package, set()).update({package_of(each, known) for each in targets} - {package})
    for package, targets in packages.items():  # importing the parent package registers the environments
        if package.startswith("viapoint.envs."):
            assert "viapoint.envs" not in targets, package
    assert without_importers(packages) == {}


def test_no_chain_of_imports_is_long():
    graph = import_graph(strings=False, typing=False)
    lengths = {}

    def chain(module):
        if module not in lengths:
            longest = max((chain(each) for each in graph[module]), key=len, default=[])
            lengths[module] = [module, *longest]
        return lengths[module]

    longest = max((chain(module) for module in graph), key=len)
    assert len(longest) <= LONGEST_CHAIN, " -> ".join(longest)


def test_no_folder_is_crowded():
    for folder in {path.parent for path in modules().values()}:
        number = len([path for path in folder.glob("*.py") if path.name != "__init__.py"])
        assert number <= MOST_MODULES, f"{folder.relative_to(ROOT)} has {number} modules"


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
            known = name.startswith("viapoint.") or {"yaml": "pyyaml"}.get(name, name).lower() in declared
            assert known or name in ("PIL", "mpl_toolkits"), f"{path.name} imports {name}"  # with matplotlib


@pytest.mark.parametrize(
    ("module", "absent"),
    [
        ("viapoint.primitives", ("torch", "mujoco", "gymnasium", "scipy", "matplotlib")),
        ("viapoint.envs", ("torch", "stable_baselines3", "matplotlib", "scipy", "viapoint.training")),
        ("viapoint.training.cli.entry", ("tyro", "rich", "tqdm", "numpy", "torch", "mujoco")),
        ("viapoint.training.cli.main", ("torch", "stable_baselines3", "matplotlib", "scipy")),
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


PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])


@pytest.mark.parametrize("page", PAGES, ids=[path.name for path in PAGES])
def test_the_commands_of_a_page_are_known(capsys, page):
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE))
    found = commands_in(page.read_text(encoding="utf-8"))
    assert page.name != "README.md" or any(line.startswith("viapoint train") for line in found)
    for line in found:
        program, *words = shlex.split(line, comments=True)
        if program == "make":
            assert {word for word in words if "=" not in word} <= targets, line
        elif len(words) > 1 and "COMMAND" not in line:
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
    """In a file every line counts; in a function its documentation does not."""
    for path in (path for folder in ("primitives", "envs", "training") for path in sources(folder)):
        text = path.read_text()
        tree = ast.parse(text)
        documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
        nodes = [node for node in ast.walk(tree) if isinstance(node, documented)]
        lines = len(text.splitlines())
        assert lines <= LONGEST_FILE, f"{path} has {lines} lines"
        for node in (node for node in nodes if isinstance(node, ast.FunctionDef)):
            length = node.end_lineno - node.lineno + 1 - _document(node)
            assert length <= LONGEST_FUNCTION, f"{path}: {node.name} has {length} lines"


def _document(node):
    """Lines of a node's documentation."""
    text = ast.get_docstring(node, clean=False)
    return 0 if text is None else text.count("\n") + 1
