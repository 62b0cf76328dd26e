"""The examples of the README run as they stand."""

import re
from pathlib import Path

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


def test_the_examples_of_the_readme_run(capsys):
    names = {}
    for example in re.findall(r"```python\n(.*?)```", README, re.DOTALL):
        exec(example, names)
    assert capsys.readouterr().out.splitlines()[-1] == "True"  # the shipped agent succeeds
    names["env"].close()
    names["envs"].close()
    assert names["position"].shape == (100, 2)
