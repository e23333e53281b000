from __future__ import annotations

import io
import json
import math
from itertools import product
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from data_tools.files.readers import JsonStream, open_json
from saga_fg.errors import InputError

values = st.recursive(
    st.none() | st.booleans() | st.integers(1 - 10**19, 10**19 - 1) | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=8,
)


def stream(text: str, piece: int = 1 << 20) -> JsonStream:
    return JsonStream(io.StringIO(text), "x.json", piece)


@given(st.lists(values, max_size=6), st.integers(1, 12), st.sampled_from([None, 1]))
def test_array_read_in_pieces_equals_json_loads(content: list[Any], piece: int, indent: int | None) -> None:
    text = json.dumps(content, indent=indent)
    reader = stream(text, piece)
    assert list(reader.array()) == json.loads(text)
    reader.end()


@given(st.dictionaries(st.text(max_size=4), values, max_size=6), st.integers(1, 12))
def test_object_read_in_pieces_equals_json_loads(content: dict[str, Any], piece: int) -> None:
    reader = stream(json.dumps(content), piece)
    assert {key: reader.value() for key in reader.members()} == content
    reader.end()


def test_number_cut_by_a_piece(subtests: pytest.Subtests) -> None:
    for number, piece in product(["1.5e-7", "-12", "1e5", "123456", "0.25"], [1, 2, 3, 4, 5]):
        with subtests.test(number=number, piece=piece):
            assert list(stream(f"[{number} , {number}]", piece).array()) == [float(number)] * 2
            assert stream(number, piece).value() == float(number)


def test_bare_nan_is_read() -> None:
    assert str(list(stream("[NaN, -Infinity]", 2).array())) == "[nan, -inf]"


@given(st.lists(values, min_size=1, max_size=4), st.data())
def test_a_truncated_array_is_an_error(content: list[Any], data: st.DataObject) -> None:
    text = json.dumps(content)
    cut = data.draw(st.integers(0, len(text) - 1))
    with pytest.raises(InputError, match=r"^x\.json: character \d+: "):
        list(stream(text[:cut], 3).array())


def test_broken_array_names_file_and_position(subtests: pytest.Subtests) -> None:
    for text in ["", "{}", "[1 2]", "[1,]", "[1", "nonsense", "[" * 100_000, "[1e]"]:
        with subtests.test(text=text), pytest.raises(InputError, match=r"^x\.json: character \d+: "):
            list(stream(text).array())


def test_broken_object_names_file_and_position(subtests: pytest.Subtests) -> None:
    for text in ['{"a" 1}', '{"a": 1,}', "{1: 2}", '{"a": 1', '{"a"']:
        with subtests.test(text=text):
            reader = stream(text)
            with pytest.raises(InputError, match=r"^x\.json: character \d+: "):
                {key: reader.value() for key in reader.members()}


def test_a_whole_number_no_float_can_hold_is_infinite(subtests: pytest.Subtests) -> None:
    for digits in [400, 4000, 5000]:
        with subtests.test(digits=digits):
            assert list(stream(f"[-{'9' * digits}, 7, 12345678901234567890]").array()) == [
                -math.inf,
                7,
                12345678901234567890.0,
            ]


def test_text_after_the_end_is_an_error() -> None:
    reader = stream("[] []")
    list(reader.array())
    with pytest.raises(InputError, match="expected the end"):
        reader.end()


def test_file_that_is_not_utf8(tmp_path) -> None:
    path = tmp_path / "x.json"
    path.write_bytes(b'["\xff\xfe"]')
    with open_json(path) as file, pytest.raises(InputError, match="expected JSON in UTF-8"):
        list(JsonStream(file, str(path)).array())


def test_file_that_is_missing(tmp_path) -> None:
    with pytest.raises(InputError, match=r"none\.json: cannot be read: No such file"):
        open_json(tmp_path / "none.json")
    with pytest.raises(InputError, match="cannot be read"):
        open_json(tmp_path)
