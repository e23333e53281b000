"""Tracker output: `Tracks` of one moment, `PredictedTracks` at future times, and both as tables to show."""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError, require_extra
from saga_fg.numerics import (
    BoolArray,
    Columns,
    FloatArray,
    IntArray,
    StrArray,
    checked,
    checked_ids,
    upper_triangle,
)
from saga_fg.types.boxes import Boxes

LONGEST = 20
"""Rows that are shown."""


def html_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str | float | int]]) -> str:
    """Return a title and the first rows of a table; NaN is left empty."""
    head = "".join(f"<th>{html.escape(name)}</th>" for name in columns)
    body = "".join(
        f"<tr>{''.join(f'<td>{html.escape(_text(value))}</td>' for value in row)}</tr>" for row in rows[:LONGEST]
    )
    more = f"<p>and {len(rows) - LONGEST} more</p>" if len(rows) > LONGEST else ""
    return f"<p>{html.escape(title)}</p><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>{more}"


def text_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str | float | int]]) -> str:
    """Return the same for a terminal."""
    cells = [columns, *([_text(value) for value in row] for row in rows[:LONGEST])]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = ("  ".join(text.rjust(width) for text, width in zip(row, widths, strict=True)) for row in cells)
    more = [f"and {len(rows) - LONGEST} more"] if len(rows) > LONGEST else []
    return "\n".join([title, *lines, *more])


def _text(value: str | float | int) -> str:
    if isinstance(value, float):
        return f"{value:.2f}" if value == value else ""
    return str(value)


class ShownTable:
    """A table that shows its first rows in a terminal and a notebook."""

    def _shown(self) -> tuple[str, Mapping[str, Any]]:
        """A title, and arrays (N,) by the heading of their column."""
        raise NotImplementedError

    def _shown_rows(self) -> tuple[str, list[str], list[tuple[str | float | int, ...]]]:
        title, columns = self._shown()
        return title, list(columns), list(zip(*(column.tolist() for column in columns.values()), strict=True))

    def __str__(self) -> str:
        return text_table(*self._shown_rows())

    def _repr_html_(self) -> str:
        return html_table(*self._shown_rows())


def data_frame(columns: Mapping[str, Any]) -> Any:
    """Return columns as a `pandas.DataFrame`. Raises `MissingExtraError` without pandas."""
    require_extra("pandas", "tables", "pandas")
    import pandas

    return pandas.DataFrame(columns)


KNOWN_SPEED_DEVIATION = 2.0  # m/s; a velocity of a larger standard deviation counts as unknown


def speed_deviation(covariance: FloatArray) -> FloatArray:
    """(N,) standard deviation in a mean direction, m/s, of velocities with the covariance (N, 2, 2)."""
    return np.asarray(np.sqrt((covariance[:, 0, 0] + covariance[:, 1, 1]) / 2))


def known_velocities(velocity: FloatArray, covariance: FloatArray) -> FloatArray:
    """(N, 2) the velocities (N, 2), m/s, NaN where their covariance (N, 2, 2) tells that they are unknown.

    A covariance of NaN tells nothing.
    """
    unknown = speed_deviation(covariance) > KNOWN_SPEED_DEVIATION
    return np.where(unknown[:, None], np.nan, velocity)


@dataclass(frozen=True)
class Track:
    """One tracked object at one moment, in world coordinates: a row of `Tracks` (units and frames there).

    Position, size and velocity are tuples, covariances arrays (2, 2); to calculate there are the columns of `Tracks`.
    """

    id: int
    label: str
    position: tuple[float, float, float]
    size: tuple[float, float, float]
    yaw: float
    velocity: tuple[float, float]
    score: float
    position_covariance: FloatArray
    velocity_covariance: FloatArray
    coasting: float
    settled: bool = True


RELATIONS = ("yields to", "takes the right of way of")


@dataclass(frozen=True, eq=False)
class Relations:
    """R relations between two tracks of one moment whose paths meet.

    source, target  (R,) ids
    name            (R,) of `RELATIONS`. yields to: `source` waits for `target`, or is about to; takes the right of way
                    of: `source` goes where it should wait for `target`, which brakes or would have to
    probability     (R,) from 0 to 1
    """

    source: IntArray
    target: IntArray
    name: StrArray
    probability: FloatArray

    @classmethod
    def of_rows(cls, rows: Sequence[tuple[int, int, str, float]]) -> Self:
        """From source, target, name and probability of each."""
        source, target, name, probability = zip(*rows, strict=True) if rows else ((),) * 4
        first, second = (np.array(each, dtype=np.int64) for each in (source, target))
        return cls(first, second, np.array(name, dtype=np.str_), np.array(probability, dtype=np.float64))

    def __len__(self) -> int:
        return len(self.source)

    def between(self, ids: IntArray) -> Self:
        """Select those whose tracks are both among the `ids` (n,)."""
        if len(self) == 0:
            return self
        kept = np.isin(self.source, ids) & np.isin(self.target, ids)
        return type(self)(self.source[kept], self.target[kept], self.name[kept], self.probability[kept])

    def rows(self) -> list[tuple[int, int, str, float]]:
        """Source, target, name and probability of each, as plain values."""
        columns = (self.source, self.target, self.name, self.probability)
        return list(zip(*(column.tolist() for column in columns), strict=True))


@dataclass(frozen=True, eq=False)
class Tracks(Columns, ShownTable):
    """All tracks of one moment, as columns, in world coordinates.

    timestamp            s
    id                   (N,)       unique, never reused within a run
    boxes                           label, position, size, yaw, velocity (filtered)
    score                (N,)       confidence, comparable within a run
    position_covariance  (N, 2, 2)  of the horizontal position, m^2
    velocity_covariance  (N, 2, 2)  (m/s)^2
    coasting             (N,)       seconds since the last detection, 0 when just updated
    settled              (N,)       False where the solver found no minimum of a nonlinear graph: the covariance is then
                                    not smaller than the predicted one; True for all if left out
    relations                       right of way between them; none if left out
    """

    timestamp: float
    id: IntArray
    boxes: Boxes
    score: FloatArray
    position_covariance: FloatArray
    velocity_covariance: FloatArray
    coasting: FloatArray
    settled: BoolArray = field(default_factory=lambda: np.empty(0, dtype=bool))
    relations: Relations = field(default_factory=lambda: Relations.of_rows([]))

    def _rows(self, rows: Any) -> Self:
        """Some tracks, and the relations between them."""
        chosen = super()._rows(rows)
        vars(chosen)["relations"] = self.relations.between(chosen.id)
        return chosen

    def __post_init__(self) -> None:
        n = len(self.boxes)
        vars(self)["id"] = checked_ids("id", self.id, n)
        for name in ("score", "coasting"):
            vars(self)[name] = checked(name, getattr(self, name), (n,))
        for name in ("position_covariance", "velocity_covariance"):
            vars(self)[name] = checked(name, getattr(self, name), (n, 2, 2))
        settled = np.asarray(self.settled, dtype=bool)
        if settled.shape not in ((n,), (0,)):
            raise InputError(f"settled: expected shape ({n},), got {settled.shape}")
        vars(self)["settled"] = settled if len(settled) else np.ones(n, dtype=bool)

    @classmethod
    def empty(cls, timestamp: float) -> Self:
        none = np.empty(0)
        return cls(
            timestamp,
            np.empty(0, dtype=np.int64),
            Boxes.empty(),
            none,
            np.empty((0, 2, 2)),
            np.empty((0, 2, 2)),
            none,
        )

    def __len__(self) -> int:
        return len(self.boxes)

    def __getitem__(self, row: int) -> Track:
        b = self.boxes
        return Track(
            id=int(self.id[row]),
            label=str(b.label[row]),
            position=tuple(b.position[row].tolist()),
            size=tuple(b.size[row].tolist()),
            yaw=float(b.yaw[row]),
            velocity=tuple(b.velocity[row].tolist()),
            score=float(self.score[row]),
            position_covariance=self.position_covariance[row],
            velocity_covariance=self.velocity_covariance[row],
            coasting=float(self.coasting[row]),
            settled=bool(self.settled[row]),
        )

    def __iter__(self) -> Iterator[Track]:
        return (self[row] for row in range(len(self)))

    def to_pandas(self) -> Any:
        """Return a `pandas.DataFrame`, a row for each track, with `table_columns`.

        Raises `MissingExtraError` without pandas.
        """
        return data_frame(self.table_columns())

    def table_columns(self) -> dict[str, Any]:
        """Return the columns (N,) of a table, named as in the files of `saga-fg track file`.

        Covariances of the horizontal position are cov_xx, cov_xy, cov_yy, of the velocity cov_vxvx and so on.
        """
        vectors: tuple[Vectors, ...] = (
            (("x", "y", "z"), self.boxes.position),
            (("length", "width", "height"), self.boxes.size),
            (("yaw",), self.boxes.yaw[:, None]),
            (("vx", "vy"), self.boxes.velocity),
            (("score",), self.score[:, None]),
            (POSITION_COVARIANCE, upper_triangle(self.position_covariance)),
            (VELOCITY_COVARIANCE, upper_triangle(self.velocity_covariance)),
            (("coasting",), self.coasting[:, None]),
        )
        first = {"timestamp": np.full(len(self), self.timestamp), "id": self.id, "label": self.boxes.label}
        return first | _components(vectors) | {"settled": self.settled}

    def _shown(self) -> tuple[str, Mapping[str, Any]]:
        shown = _placed(self.boxes.position, self.boxes.velocity, self.position_covariance)
        last = {"score": self.score, "unseen for, s": self.coasting}
        title = f"{len(self)} tracks at {self.timestamp:.3f} s"
        return title, {"id": self.id, "class": self.boxes.label, **shown, **last}


Vectors = tuple[tuple[str, ...], FloatArray]
"""Names of components, and the vectors (N, n) of these."""

POSITION_COVARIANCE = ("cov_xx", "cov_xy", "cov_yy")
VELOCITY_COVARIANCE = ("cov_vxvx", "cov_vxvy", "cov_vyvy")


def _components(vectors: Sequence[Vectors]) -> dict[str, FloatArray]:
    return {name: values[:, k] for names, values in vectors for k, name in enumerate(names)}


def _placed(position: FloatArray, velocity: FloatArray, covariance: FloatArray) -> dict[str, FloatArray]:
    """Columns that show positions (n, 2 or 3), velocities (n, 2) and the covariance (n, 2, 2) of positions."""
    deviation = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2)
    speed = np.linalg.norm(velocity, axis=1)
    return {"x, m": position[:, 0], "y, m": position[:, 1], "position ±, m": deviation, "speed, m/s": speed}


LONGEST_PREDICTION = 60.0  # s; nobody knows where traffic is a minute later, and time runs out before


Hypothesis = Literal["moving", "stationary", "waits", "follows", "goes on"]


@dataclass(frozen=True, eq=False)
class PredictedMode:
    """How N tracks go on in one of some cases: they move, or stand where they were last; those that move may wait for
    others, follow their leaders, or go on along their paths.

    probability  (H, N)  of this case at each horizon; the other columns are as in `PredictedTracks`, given the case
    """

    name: Hypothesis
    probability: FloatArray
    position: FloatArray
    velocity: FloatArray
    position_covariance: FloatArray
    velocity_covariance: FloatArray


LEAST_MODE = 1e-3
"""Probability below which a mode is left out of tables."""

HIDDEN = 0.3
"""Seconds without detection from which an object is hidden."""

SHOWN_MODE = 0.05
"""Least probability of a mode of a hidden object that is shown."""


@dataclass(frozen=True, eq=False)
class PredictedTracks(ShownTable):
    """The N tracks of one moment at H future times, in world coordinates.

    timestamp            s, of the moment from which they are predicted
    horizons             (H,)          s after it, increasing
    id, label            (N,)          of the tracks
    position             (H, N, 2)     mean, m
    velocity             (H, N, 2)     mean, m/s
    yaw                  (H, N)        heading, rad; NaN where it is unknown
    position_covariance  (H, N, 2, 2)  m^2
    velocity_covariance  (H, N, 2, 2)  (m/s)^2
    coasting             (N,)          s since the last detection, at `timestamp`
    modes                              moving and stationary, of which mean and covariance are the mixture's; if
                                       hypotheses were asked for, waits, follows and goes on stand for moving, beside
                                       the same mean and covariance
    joint_covariance     (H, 2N, 2N)   of all positions (x_1, y_1, x_2, ...), m^2; None unless it was asked for
    """

    timestamp: float
    horizons: FloatArray
    id: IntArray
    label: StrArray
    position: FloatArray
    velocity: FloatArray
    yaw: FloatArray
    position_covariance: FloatArray
    velocity_covariance: FloatArray
    coasting: FloatArray
    modes: tuple[PredictedMode, ...]
    joint_covariance: FloatArray | None = None

    @classmethod
    def empty(cls, timestamp: float, horizons: FloatArray) -> Self:
        """No tracks, predicted to horizons (H,), s."""
        h = len(horizons)
        none, vectors, matrices = np.empty((h, 0)), np.empty((h, 0, 2)), np.empty((h, 0, 2, 2))
        ids, label = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.str_)
        modes = (PredictedMode("moving", none, vectors, vectors, matrices, matrices),)
        return cls(timestamp, horizons, ids, label, vectors, vectors, none, matrices, matrices, np.empty(0), modes)

    def __len__(self) -> int:
        return len(self.id)

    @property
    def times(self) -> FloatArray:
        """(H,) timestamps of the predictions, s."""
        return np.asarray(self.timestamp + self.horizons)

    def to_pandas(self) -> Any:
        """Return a `pandas.DataFrame` of `table_columns`. Raises `MissingExtraError` without pandas."""
        return data_frame(self.table_columns())

    def table_columns(self, modes: bool = False, hidden: bool = False) -> dict[str, Any]:
        """Return the columns of a table, a row for each horizon and track, named as in the files of `--predict`.

        modes: a row for each mode, with its name and probability, in place of their mean and covariance. hidden: those
        alone of objects without detection that may go on in several ways.
        """
        if not modes:
            return self._names() | self._state_columns(self)
        parts = [
            self._names()
            | {"mode": np.full(mode.probability.size, mode.name), "probability": mode.probability.ravel()}
            | self._state_columns(mode)
            for mode in self.modes
        ]
        whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        order = np.arange(len(whole["id"])).reshape(len(parts), -1).T.ravel()  # the modes of a track together
        share = np.stack([mode.probability for mode in self.modes])
        kept = share >= (SHOWN_MODE if hidden else LEAST_MODE)
        if hidden:
            kept &= (kept.sum(axis=0) > 1) & (self.coasting > HIDDEN)
        order = order[kept.ravel()[order]]
        return {name: column[order] for name, column in whole.items()}

    def _names(self) -> dict[str, Any]:
        h, n = len(self.horizons), len(self)
        times = {"timestamp": np.full(h * n, self.timestamp), "horizon": np.repeat(self.horizons, n)}
        return times | {"id": np.tile(self.id, h), "label": np.tile(self.label, h)}

    def _state_columns(self, of: PredictedTracks | PredictedMode) -> dict[str, FloatArray]:
        vectors: tuple[Vectors, ...] = (
            (("x", "y"), of.position.reshape(-1, 2)),
            (("yaw",), self.yaw.reshape(-1, 1)),
            (("vx", "vy"), of.velocity.reshape(-1, 2)),
            (POSITION_COVARIANCE, upper_triangle(of.position_covariance.reshape(-1, 2, 2))),
            (VELOCITY_COVARIANCE, upper_triangle(of.velocity_covariance.reshape(-1, 2, 2))),
        )
        return _components(vectors)

    def _shown(self) -> tuple[str, Mapping[str, Any]]:
        names = self._names()
        rows = self.position.reshape(-1, 2), self.velocity.reshape(-1, 2), self.position_covariance.reshape(-1, 2, 2)
        first = {"id": names["id"], "class": names["label"], "after, s": names["horizon"]}
        return f"{len(self)} tracks, predicted from {self.timestamp:.3f} s", {**first, **_placed(*rows)}


def within_reach(ahead: FloatArray) -> bool:
    """True for increasing times (H,) after the newest frame, s, to which tracks can be predicted."""
    return bool(ahead[0] >= 0 and ahead[-1] <= LONGEST_PREDICTION)


def checked_horizons(horizons: ArrayLike) -> FloatArray:
    """Return horizons (H,), s; `InputError` unless they increase, from 0 to `LONGEST_PREDICTION`, one at least."""
    if np.ndim(horizons) == 0:
        raise InputError(f"horizons: expected a list of seconds, got {horizons!r:.40}")
    found = checked("horizons", horizons, (None,))
    if len(found) == 0 or found[0] < 0 or found[-1] > LONGEST_PREDICTION or (np.diff(found) <= 0).any():
        raise InputError(
            f"horizons: expected increasing seconds from 0 to {LONGEST_PREDICTION:g}, at least one, "
            f"got {found.tolist()}"
        )
    return found
