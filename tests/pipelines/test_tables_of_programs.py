"""`saga_fg.evaluate` and `saga_fg.view`: as the command says, for tables of pandas, Polars and Arrow."""

import dataclasses
import json
import re
import warnings

import numpy as np
import pytest

import saga_fg
from saga_fg import InputError
from saga_fg.tables.column_names import TableImport
from saga_fg.tracking import plain_settings
from tests.pipelines.command import done

pd = pytest.importorskip("pandas")
NOISE = np.random.default_rng(0)
ROWS = [(k / 10, n, "car", 10 * k / 10 - 12 * n, 0.0) for k in range(30) for n in range(3)]
TRUTH = pd.DataFrame(ROWS, columns=["timestamp", "id", "label", "x", "y"])
DETECTIONS = TRUTH.drop(columns="id").assign(x=TRUTH.x + NOISE.normal(0, 0.1, len(TRUTH)))


@pytest.fixture(scope="module")
def tracks():
    return saga_fg.track(DETECTIONS)


def test_the_figures_are_those_of_the_command(tracks, tmp_path):
    tracks.to_csv(tmp_path / "tracks.csv", index=False)
    TRUTH.to_csv(tmp_path / "truth.csv", index=False)
    figures = tmp_path / "figures.json"
    done("evaluate", "file", tmp_path / "tracks.csv", "--truth", tmp_path / "truth.csv", "--json", figures)
    expected = json.loads(figures.read_text())["tracking"]["overall"]
    found = saga_fg.evaluate(tracks, TRUTH)
    assert found.figures()["tracking"]["overall"]["mota"] == expected["mota"] > 0.9
    assert "AMOTA" in repr(found)
    assert found._repr_html_().count("<table>") > 2


def test_labels_and_tracks_are_judged_as_they_come(tracks):
    labels = saga_fg.smooth(DETECTIONS)
    of_labels, of_table = (saga_fg.evaluate(each, TRUTH).figures() for each in (labels, labels.boxes()))
    assert str(of_labels) == str(of_table)
    tracker, moments = saga_fg.Tracker(saga_fg.TrackerSettings(min_hits=2)), saga_fg.frames_of(DETECTIONS)
    found = [tracker.step(frame) for frame in moments]
    assert saga_fg.evaluate(found, TRUTH).figures()["tracking"]["overall"]["mota"] > 0.9
    assert saga_fg.evaluate(found[-1], TRUTH[TRUTH.timestamp == 2.9]).figures()["tracking"]["overall"]["mota"] == 1


@pytest.mark.parametrize("options", [{"method": "kf"}, {"method": "centerpoint"}, {"estimator": "isam2"}])
def test_methods_and_estimators_are_those_of_the_command(options, tmp_path):
    table, result = tmp_path / "found.csv", tmp_path / "tracks.csv"
    DETECTIONS.to_csv(table, index=False)
    done(
        "track",
        "file",
        table,
        *(text for name, value in options.items() for text in (f"--{name}", value)),
        "--output",
        result,
    )
    by_name = dict(options)
    if "estimator" in options:
        by_name = {"settings": dataclasses.replace(plain_settings(), **options)}
    found = saga_fg.track(DETECTIONS, **by_name)
    expected = pd.read_csv(result)
    pd.testing.assert_frame_equal(
        found[["timestamp", "id", "x", "y"]], expected[["timestamp", "id", "x", "y"]], atol=1e-3
    )
    with pytest.raises(InputError, match="settings: expected None with method='centerpoint'"):
        saga_fg.track(DETECTIONS, "plain", method="centerpoint")


@pytest.mark.parametrize("kind", ["polars", "pyarrow"])
def test_other_tables_are_judged_alike(kind, tracks):
    module = pytest.importorskip(kind)
    made = module.from_pandas if kind == "polars" else module.Table.from_pandas
    one, other = saga_fg.evaluate(made(tracks), made(TRUTH)), saga_fg.evaluate(tracks, TRUTH)
    assert one.tracking == other.tracking


def test_tracks_of_others_are_understood_by_names_and_units(tracks):
    theirs = tracks[["timestamp", "id", "label", "x", "y"]].rename(columns={"id": "number", "x": "what"})
    with pytest.raises(InputError, match="expected a column 'id'"):
        saga_fg.evaluate(theirs, TRUTH)
    how = TableImport(columns={"id": "number", "x": "what"}, classes={"car": "vehicle"})
    found = saga_fg.evaluate(theirs, TRUTH, how, TableImport(classes={"car": "vehicle"}), hota=False)
    assert "vehicle" in found.figures()["tracking"]
    assert found.figures()["tracking"]["overall"]["mota"] > 0.9


def test_metrics_of_ones_own_stand_beside(tracks):
    def boxes(scenes):
        return {"found": sum(len(found) for _, found in scenes)}

    found = saga_fg.evaluate(tracks, TRUTH, metrics=[boxes])
    assert found.figures()["own"] == {"boxes": {"found": len(tracks)}}
    assert found.tables()[-1].title == "boxes"
    assert "AMOTA" in repr(found)
    assert "boxes\nfigure" in repr(found).replace(" ", "")
    with pytest.raises(InputError, match="metric: <lambda>: ZeroDivisionError"):
        saga_fg.evaluate(tracks, TRUTH, metrics=[lambda scenes: 1 / 0])


def test_tables_that_do_not_fit_are_refused(tracks):
    with pytest.raises(InputError, match=r"how: expected .*TableImport.*dict"):
        saga_fg.evaluate(tracks, TRUTH, {"columns": {"x": "pos_x"}})
    with pytest.raises(InputError, match="expected tracks at the times of the ground truth"):
        saga_fg.evaluate(tracks, TRUTH.assign(timestamp=TRUTH.timestamp + 100))
    with pytest.raises(InputError, match="expected a column 'id'"):
        saga_fg.evaluate(tracks, DETECTIONS)
    with pytest.raises(InputError, match="expected a table of pandas, Polars or Arrow, got int"):
        saga_fg.evaluate(3, TRUTH)
    with warnings.catch_warnings(), pytest.raises(InputError, match=r"expected a file name that ends in \.html"):
        saga_fg.view(tracks).write("page.txt")


def test_a_page_shows_tracks_beside_detections_and_truth(tracks, tmp_path):
    page = saga_fg.view(tracks, DETECTIONS, TRUTH)
    page.write(tmp_path / "page.html")
    assert (tmp_path / "page.html").read_text() == page.text
    assert "MOTA" in page.text
    assert "MOTA" not in saga_fg.view(tracks).text
    assert page._repr_html_().startswith("<iframe")
    assert repr(page).startswith(f"1 scene, {len(tracks)} boxes: a page of")


def test_labels_of_boxes_seen_from_above_keep_their_sizes():
    found = saga_fg.smooth(DETECTIONS.assign(length=4.5, width=1.8)).boxes()
    assert found["length"].to_numpy() == pytest.approx(4.5)
    assert found["width"].to_numpy() == pytest.approx(1.8)
    assert found["height"].isna().all()


def test_what_mends_a_table_is_named_as_each_function_takes_it(tracks, subtests):
    """What a stop names, put into the call that stopped, makes it go on."""
    slow, theirs = (
        DETECTIONS.assign(timestamp=1e9 * DETECTIONS.timestamp),
        tracks[["timestamp", "id", "label", "x", "y"]],
    )
    late = theirs.assign(timestamp=1e9 * theirs.timestamp)
    cases = {
        "track": lambda **how: saga_fg.track(slow, **how),
        "predict": lambda **how: saga_fg.predict(slow, **how),
        "smooth": lambda **how: saga_fg.smooth(slow, **how),
        "frames_of": lambda **how: saga_fg.frames_of(slow, **how),
        "evaluate": lambda **how: saga_fg.evaluate(late, TRUTH, truth_how=TableImport(), hota=False, **how),
        "view": lambda **how: saga_fg.view(late, **how),
        "truth": lambda **how: saga_fg.evaluate(
            theirs, TRUTH.assign(timestamp=1e9 * TRUTH.timestamp), hota=False, **{"truth_how": TableImport(), **how}
        ),
    }
    for name, call in cases.items():
        with subtests.test(name):
            with pytest.raises(InputError, match="as it is") as stopped:
                call()
            mend, otherwise = re.search(r"; add (.*); (.*) reads it as it is", str(stopped.value)).groups()
            names = {"TableImport": TableImport}
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                call(**eval(f"dict({mend})", names))
            (how,) = eval(f"dict({otherwise})", names).values()
            assert how.values() == {"as_given": True}


def test_a_column_that_is_not_found_is_named_as_the_function_takes_it(tracks):
    for call, text in [
        (
            lambda: saga_fg.track(DETECTIONS.rename(columns={"x": "what"})),
            "name it: how=TableImport(columns={'x': 'NAME'})",
        ),
        (lambda: saga_fg.smooth(DETECTIONS.rename(columns={"x": "what"})), "how=TableImport(columns={'x': 'NAME'})"),
        (
            lambda: saga_fg.evaluate(tracks, TRUTH.rename(columns={"y": "what"}), truth_how=TableImport()),
            "name it: truth_how=TableImport(columns={'y': 'NAME'})",
        ),
    ]:
        with pytest.raises(InputError, match=re.escape(text)):
            call()


def test_classes_that_have_no_counterpart_are_named_with_the_argument(tracks, caplog):
    saga_fg.evaluate(tracks, TRUTH.assign(label="AUTO"), hota=False)
    assert "name them alike: how=TableImport(classes={'AUTO': 'car'})" in caplog.text


def test_an_option_that_tracks_or_truth_alone_need_serves_all_functions(tracks):
    how = TableImport(columns={"id": "name", "score": "certainty"})
    truth = TRUTH.rename(columns={"id": "name"})
    assert saga_fg.evaluate(tracks, truth, how=how, hota=False).tracking
    with pytest.raises(InputError, match="there is no column 'certainty'"):
        saga_fg.track(DETECTIONS, how=how)
    only = TableImport(columns={"id": "name"})
    pd.testing.assert_frame_equal(saga_fg.track(DETECTIONS, how=only), saga_fg.track(DETECTIONS))


def test_the_unit_at_the_end_of_a_named_column_counts():
    named = DETECTIONS.assign(east_cm=100 * DETECTIONS.x).drop(columns="x")
    found = saga_fg.track(named, how=TableImport(columns={"x": "east_cm"}))
    pd.testing.assert_frame_equal(found, saga_fg.track(DETECTIONS))


def test_tracks_at_a_lower_rate_are_judged_where_they_are(tracks, caplog):
    times = np.unique(tracks.timestamp)
    seldom = tracks[tracks.timestamp.isin(times[::5])]
    found = saga_fg.evaluate(seldom, TRUTH, hota=False)
    assert "judged at the" in caplog.text
    assert found.programs["tracking"]["overall"]["objects"] < len(TRUTH) / 4
    with pytest.raises(InputError, match="expected tracks at the times of the ground truth"):
        saga_fg.evaluate(tracks[tracks.timestamp.isin([*times[:3], *times[20:23], *times[-3:]])], TRUTH)
