"""The notebooks of the tutorials run from top to bottom."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"
RUN = "import json, pathlib, sys, notebooks; json.dump(notebooks.run(pathlib.Path(sys.argv[1])), sys.stdout)"


@pytest.mark.parametrize("path", sorted(DOCS.glob("tutorials/*.ipynb")), ids=lambda path: path.stem)
def test_a_tutorial_runs(path):
    folders = os.pathsep.join((str(DOCS), os.environ.get("PYTHONPATH", "")))
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": folders}
    command = [sys.executable, "-c", RUN, str(path)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    stored = json.loads(path.read_text(encoding="utf-8"))["cells"]
    assert kinds_of_outputs(stored) == kinds_of_outputs(json.loads(done.stdout))


def kinds_of_outputs(cells):
    """Return the kinds of outputs of each code cell: text or pictures."""
    return [[each["output_type"] for each in cell["outputs"]] for cell in cells if "outputs" in cell]
