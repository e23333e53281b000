"""The API pages: fields and parameters as tables, from the docstrings as they are."""

import sys
from pathlib import Path

import pytest

griffe = pytest.importorskip("griffe", reason="the site comes with the extra docs")
ROOT = Path(__file__).parents[1]
CODE = '''
"""Module."""
@dataclass(frozen=True)
class Rows:
    """Some rows.

    first, second  (N,) numbers, m
    third          of a kind,
                   in two lines

    More text.
    """
    first: FloatArray
    second: FloatArray
    third: int = 0
    limit: float = setting(1.0, "largest number, m")
    _hidden: int = 0

def add(a: int, b: int = 2) -> int:
    """The sum.

    a  one of them
    """
'''


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "path", [str(ROOT / "docs"), *sys.path])
    from field_tables import FieldTables  # type: ignore[import-not-found]

    return griffe.visit("page", Path("page.py"), CODE, extensions=griffe.load_extensions(FieldTables))


def test_fields_become_a_table_with_their_types_and_comments(module):
    text, fields, more = module["Rows"].docstring.parsed
    assert (text.value, more.value) == ("Some rows.", "More text.")
    rows = {row.name: (str(row.annotation), row.description) for row in fields.value}
    assert rows == {
        "first": ("FloatArray", "(N,) numbers, m"),
        "second": ("FloatArray", "(N,) numbers, m"),
        "third": ("int", "of a kind, in two lines"),
        "limit": ("float", "largest number, m"),
    }


def test_parameters_become_a_table_with_their_defaults(module):
    text, parameters = module["add"].docstring.parsed
    assert text.value == "The sum."
    assert [(row.name, str(row.annotation), row.description) for row in parameters.value] == [
        ("a", "int", "one of them")
    ]
