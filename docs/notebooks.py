"""Notebooks of the tutorials: `python docs/notebooks.py` runs them and stores what their cells print and draw."""

from __future__ import annotations

import argparse
import ast
import base64
import contextlib
import io
import json
import sys
from pathlib import Path
from typing import Any

TUTORIALS = Path(__file__).parent / "tutorials"


def run(path: Path) -> list[dict[str, Any]]:
    """Execute the code cells of a notebook in one namespace and its folder, and return its cells with outputs."""
    import matplotlib as mpl

    mpl.use("Agg")
    cells: list[dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))["cells"]
    space: dict[str, Any] = {"__name__": "__main__"}
    number = 0
    with contextlib.chdir(path.parent):
        for cell in cells:
            if cell["cell_type"] == "code":
                number += 1
                cell["execution_count"] = number
                cell["outputs"] = executed("".join(cell["source"]), space, f"{path.name}, cell {number}")
    return cells


def executed(source: str, space: dict[str, Any], name: str) -> list[dict[str, Any]]:
    """Execute a cell, and return what it prints, the value of its last line and its figures as outputs."""
    tree, last = ast.parse(source, name), None
    if tree.body and isinstance(tree.body[-1], ast.Expr):
        last = ast.Expression(tree.body.pop().value)  # type: ignore[attr-defined]
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(tree, name, "exec"), space)
        value = None if last is None else eval(compile(last, name, "eval"), space)
    outputs: list[dict[str, Any]] = []
    if printed.getvalue():
        text = printed.getvalue().splitlines(keepends=True)
        outputs.append({"output_type": "stream", "name": "stdout", "text": text})
    drawn = figures()
    outputs += [display({"image/png": figure}) for figure in drawn]
    if value is not None and not drawn:
        outputs.append(display({"text/plain": repr(value).splitlines(keepends=True)}))
    return outputs


def display(data: dict[str, Any]) -> dict[str, Any]:
    """Return an output of a cell that shows data."""
    return {"output_type": "display_data", "data": data, "metadata": {}}


def figures() -> list[str]:
    """Return the open figures of Matplotlib as base64 of small PNG files, and close them."""
    from matplotlib import pyplot as plt
    from PIL import Image

    found = []
    for number in plt.get_fignums():
        drawn, small = io.BytesIO(), io.BytesIO()
        plt.figure(number).savefig(drawn, dpi="figure", bbox_inches="tight")
        Image.open(drawn).convert("RGB").quantize(64, dither=Image.Dither.NONE).save(
            small, "PNG", optimize=True
        )
        found.append(base64.b64encode(small.getvalue()).decode())
    plt.close("all")
    return found


def markdown(text: str) -> str:
    """Return a notebook as Markdown of MyST: code as blocks, with outputs below."""
    parts = []
    for cell in json.loads(text)["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        for output in cell["outputs"]:
            data = output.get("data", {})
            shown = "".join(output.get("text", data.get("text/plain", "")))
            if shown:
                parts.append(f"```text\n{shown.rstrip()}\n```")
            if "image/png" in data:
                parts.append(f'<p><img alt="Figure" src="data:image/png;base64,{data["image/png"]}"></p>')
    return "\n\n".join(parts) + "\n"


def main() -> None:
    """Run the notebooks and store their outputs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("paths", nargs="*", type=Path, default=sorted(TUTORIALS.glob("*.ipynb")))
    for path in parser.parse_args().paths:
        notebook = json.loads(path.read_text(encoding="utf-8"))
        notebook["cells"] = run(path)
        path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        print(path, f"{path.stat().st_size / 1000:.0f} kB", file=sys.stderr)


if __name__ == "__main__":
    main()
