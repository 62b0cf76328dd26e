"""The examples of the README run as they stand; tests/benchmarks/test_results.py compares its numbers."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_examples_of_the_readme_run(capsys):
    names = {}
    for example in re.findall(r"```python\n(.*?)```", README, re.DOTALL):
        exec(example, names)
    assert capsys.readouterr().out.startswith("True ")  # the shipped agent succeeds
    assert names["result"].success_rate >= 0.9
    names["env"].close()
    names["envs"].close()
    assert names["position"].shape == (100, 2)
    assert names["movement"].sample(100)[0].shape == (100, 2)


def test_the_links_of_the_readme_exist():
    for target in re.findall(r"\]\(([^)#]+)", README):
        assert target.startswith("https://") or (ROOT / target).exists(), target
