"""The runner of benchmarks: options and output, contenders in turn, and intervals."""

import json
import math
from collections.abc import Iterator
from typing import Annotated, Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from benchmarks.runner import Interval, Rows, application, environment, growth, in_turn, resampled, tables, text
from saga_fg.errors import SagaError


def counting(
    to: Annotated[int, typer.Option("--to", help="Rows.")] = 2,
    broken: Annotated[bool, typer.Option("--broken", help="Fail at the end.")] = False,
) -> Rows:
    """Count."""
    for number in range(to):
        yield "numbers", {"number": number, "half": number / 2, "change": Interval(-0.1, -0.2, math.nan, 0.95)}
    if broken:
        raise SagaError("it broke")


def nothing() -> Rows:
    """Yield nothing."""
    yield from ()


APP = application((counting, nothing))


def test_a_benchmark_is_a_function_that_yields_rows(tmp_path):
    files = tmp_path / "f.json", tmp_path / "t.md"
    options = ["counting", "--to", "3", "--json", str(files[0]), "--markdown", str(files[1])]
    done = CliRunner().invoke(APP, options)
    assert done.exit_code == 0, done.output
    assert "numbers" in done.stdout
    assert "numba" in done.stdout
    told = json.loads(files[0].read_text())
    assert told["benchmark"] == "counting"
    assert told["options"] == {"to": "3", "broken": "False"}
    assert [row["number"] for row in told["rows"]] == [0, 1, 2]
    assert told["rows"][0]["change"]["high"] is None
    assert "| 2 | 1 |" in files[1].read_text()
    assert "Count." in CliRunner().invoke(APP, ["counting", "--help"]).stdout


def test_what_was_found_before_an_error_is_shown(tmp_path):
    done = CliRunner().invoke(APP, ["counting", "--broken", "--json", str(tmp_path / "f.json")])
    assert done.exit_code == 2
    assert "error: it broke" in done.stderr
    assert "numbers" in done.stdout
    assert len(json.loads((tmp_path / "f.json").read_text())["rows"]) == 2
    assert CliRunner().invoke(APP, ["nothing"]).stdout == ""


def test_columns_are_those_of_all_rows_and_the_environment_names_versions():
    (table,) = tables([("t", {"a": 1, "b": 2.0}), ("t", {"a": None, "c": math.nan})])
    assert table.columns == ("a", "b", "c")
    assert table.rows == (("1", "2", ""), ("", "", "-"))
    assert text(Interval(-0.1, -0.2, 0.05, 0.95)) == "-0.1 (-0.2 to +0.05)"
    assert text(Interval(0.5, math.nan, math.nan, 0.95)) == "+0.5 (-)"
    assert growth([1, 10, 100], [5.0, 500.0, 50_000.0]) == pytest.approx(2.0)
    assert math.isnan(growth([1], [1.0]))
    assert {"numba", "numpy", "gtsam"} <= set(environment())


def test_contenders_take_turns_and_what_they_prepare_is_not_timed():
    order: list[tuple[str, str, int]] = []

    def contender(name: str) -> Any:
        def prepare(item: int) -> Any:
            order.append((name, "prepares", item))
            return lambda: order.append((name, "steps", item))

        return prepare

    def items() -> Iterator[int]:
        for item in range(3):
            yield item
            order.append(("", "judged", item))

    times = in_turn({"a": contender("a"), "b": contender("b")}, items(), warm_up=1)
    assert {name: len(spent) for name, spent in times.items()} == {"a": 2, "b": 2}
    first = [("a", "prepares", 0), ("a", "steps", 0), ("b", "prepares", 0), ("b", "steps", 0), ("", "judged", 0)]
    assert order[:5] == first
    assert len(in_turn({"a": contender("a")}, items(), warm_up=1, seconds=-1.0)["a"]) == 1


def test_scenes_of_one_unit_are_drawn_together():
    values = np.array([0.0, 1.0, 0.0, 1.0])

    def figures(rows: Any) -> dict[str, float]:
        return {"mean": float(values[list(rows)].mean())}

    apart = resampled(figures, [[0], [1], [2], [3]], 200)["mean"]
    together = resampled(figures, [[0, 1], [2, 3]], 200)["mean"]
    assert apart.estimate == together.estimate == 0.5
    assert apart.low < 0.2
    assert apart.high > 0.8
    assert (together.low, together.high) == (0.5, 0.5)
