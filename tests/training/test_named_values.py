"""NAME=VALUE says one thing, or is refused with what is meant."""

import json

import pytest

from viapoint.training.config.key_values import from_words


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("2", 2),
        ("-1.5e-3", -0.0015),
        ("true", True),
        ("null", None),
        ("[1,8]", [1, 8]),
        ('{"a":[16]}', {"a": [16]}),
    ],
)
def test_json_is_what_it_says(text, value):
    assert from_words([f"x={text}"]) == {"x": value}


@pytest.mark.parametrize("word", ["learned", "log_success", "auto_0.1", "a=b", "yes", ""])
def test_words_are_words(word):
    assert from_words([f"x={word}"]) == {"x": word}


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("True", "true"),
        ("None", "null"),
        ("(1,8)", "[1,8]"),
        ("(1, 8)", "[1,8]"),
        (".5", "0.5"),
        ("'a'", '"a"'),
    ],
)
def test_what_is_python_only_is_refused_with_its_json(text, meant):
    with pytest.raises(ValueError, match="is no JSON") as error:
        from_words([f"x={text}"])
    assert str(error.value).endswith(f"x={meant}")
    json.loads(meant)


@pytest.mark.parametrize("text", ["nan", "NaN", "Infinity", "inf", "[1,8", '{"a":', "(1"])
def test_what_is_neither_is_refused(text):
    with pytest.raises(ValueError, match=r"x=.* is no JSON"):
        from_words([f"x={text}"])


@pytest.mark.parametrize("words", [["n_via=2", "n_via=3"], ["n_via=2", "other=1", "n_via=2"]])
def test_a_name_is_there_once(words):
    with pytest.raises(ValueError, match="n_via is there twice"):
        from_words(words)


@pytest.mark.parametrize("word", ["n_via", "=3"])
def test_a_value_has_a_name(word):
    with pytest.raises(ValueError, match="must be NAME=VALUE"):
        from_words([word])
