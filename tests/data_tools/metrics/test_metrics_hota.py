"""HOTA, CLEAR and Identity through trackeval: small cases worked out by hand."""

import sys

import numpy as np
import pytest

from data_tools.metrics import SceneBoxes, hota_metrics
from saga_fg import Boxes, InputError, MissingExtraError


def table(rows, label="car"):
    """SceneBoxes from (frame, id, x); boxes of 4 x 2 x 1.5 m."""
    n = len(rows)
    return SceneBoxes(
        np.array([row[0] for row in rows], dtype=np.int64),
        np.array([row[1] for row in rows], dtype=str),
        Boxes.of([label] * n, [(row[2], 0.0, 0.0) for row in rows], [(4.0, 2.0, 1.5)] * n, [0.0] * n),
        np.zeros(n),
    )


CAR = table([(k, "a", 5.0 * k) for k in range(10)])


def test_perfect_tracks():
    pytest.importorskip("trackeval")
    for similarity in ("centre", "bev_iou", "iou_3d"):
        f = hota_metrics([(CAR, CAR)], "car", similarity)
        assert (f.hota, f.deta, f.assa, f.loca, f.mota, f.idf1) == pytest.approx((1.0,) * 6)
        assert (f.fp, f.fn, f.ids, f.frag) == (0, 0, 0, 0)
    assert f.hota_at == pytest.approx(np.ones(19))
    assert f.alpha == pytest.approx(np.arange(0.05, 0.96, 0.05))


def test_a_broken_track_by_hand():
    pytest.importorskip("trackeval")
    # The object is followed by two tracks, each for half of the time: every pair has TPA 5, FNA 5, FPA 0.
    broken = table([(k, "t" if k < 5 else "u", 5.0 * k) for k in range(10)])
    f = hota_metrics([(CAR, broken)], "car")
    assert (f.deta, f.assa, f.hota) == pytest.approx((1.0, 0.5, np.sqrt(0.5)))
    assert (f.ids, f.mota) == (1, 0.9)
    assert (f.idf1, f.idp, f.idr) == pytest.approx((0.5, 0.5, 0.5))


def test_similarity_decides_from_which_alpha_on_a_pair_counts():
    pytest.importorskip("trackeval")
    shifted = table([(k, "t", 5.0 * k + 0.9) for k in range(10)])
    f = hota_metrics([(CAR, shifted)], "car", "centre", reach=4.0)
    assert f.loca < 1.0
    assert f.hota_at == pytest.approx((np.arange(0.05, 0.96, 0.05) < 0.775).astype(float))
    assert f.motp == pytest.approx(0.775)
    f = hota_metrics([(CAR, shifted)], "car", "iou_3d")
    assert f.motp == pytest.approx(3.1 / 4.9)
    assert hota_metrics([(CAR, shifted)], "car", "iou_3d", threshold=0.7).mota == pytest.approx(-1.0)


def test_scenes_are_put_together_and_classes_kept_apart():
    pytest.importorskip("trackeval")
    nothing = table([])
    other = table([(0, "x", 0.0)], "truck")
    f = hota_metrics([(CAR, CAR), (CAR, nothing), (nothing, other)], "car")
    assert (f.fn, f.fp) == (10, 0)
    assert f.deta == pytest.approx(0.5)
    assert f.assa == pytest.approx(1.0)
    assert f.idr == pytest.approx(0.5)


def test_the_extra_is_named_where_it_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "trackeval", None)
    with pytest.raises(MissingExtraError, match=r"saga-fg\[eval\]"):
        hota_metrics([(CAR, CAR)], "car")


def test_bad_input():
    with pytest.raises(InputError, match="similarity: expected one of centre, bev_iou, iou_3d"):
        hota_metrics([(CAR, CAR)], "car", "giou")
    with pytest.raises(InputError, match="at least one scene"):
        hota_metrics([], "car")
