"""The public names of the package: complete, documented, and with examples that run."""

import doctest
import enum
import inspect

import pytest

from viapoint import primitives

PUBLIC = {
    "FREE",
    "CostGradient",
    "Extrema",
    "SpeedEvents",
    "Trajectory",
    "cost_gradient",
    "curvature",
    "dimensionless_jerk",
    "log_dimensionless_jerk",
    "minimum_duration",
    "minimum_jerk_coefficients",
    "passage_durations",
    "point_to_point",
    "retarget",
    "spectral_arc_length",
    "speed",
    "speed_peaks",
    "speed_valleys",
    "through",
}


def documented(name):
    """Return the object that carries the documentation of an exported name."""
    value = getattr(primitives, name)
    return type(value) if isinstance(value, enum.Enum) else value


def test_the_exported_names_are_the_public_api():
    assert set(primitives.__all__) == PUBLIC
    assert len(primitives.__all__) == len(PUBLIC)


@pytest.mark.parametrize("name", primitives.__all__)
def test_examples_run(name):
    value = documented(name)
    tests = doctest.DocTestFinder(recurse=inspect.isclass(value)).find(value, name, globs={})
    assert any(test.examples for test in tests), f"{name} has no example"
    runner = doctest.DocTestRunner()
    for test in tests:
        report = []
        assert not runner.run(test, out=report.append).failed, "".join(report)


@pytest.mark.parametrize("name", [n for n in primitives.__all__ if inspect.isfunction(documented(n))])
def test_functions_document_arguments_result_and_errors(name):
    function = documented(name)
    text = inspect.getdoc(function)
    assert all(f"\n{part}:\n" in text for part in ("Args", "Returns", "Raises", "Example"))
    for argument in inspect.signature(function).parameters:
        assert f"\n    {argument}: " in text, f"{name} does not describe {argument}"
