"""The report: one file, true to result.json, that fetches nothing."""

import html.parser

import numpy as np
import pytest

from prism_jax.geometry.camera import Camera
from prism_jax.io import Scan
from prism_jax.report import (
    Completed,
    render_report,
    render_scene_report,
    viewing_direction,
)
from prism_jax.result import plain, score, summarize, summarize_scene
from tests.fake_completer import FakeCompleter

POINTS = np.random.default_rng(0).normal(size=(300, 3)).astype(np.float32)


ASKED = {"weights": "small", "up": "z", "bounds": None, "density": 1.0}


class Outline(html.parser.HTMLParser):
    """Tags, what they would fetch, and the text outside scripts and styles."""

    def __init__(self, page: str):
        super().__init__()
        self.tags, self.fetched, self.text, self._stack = [], [], "", []
        self.feed(page)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.fetched += [v for k, v in attrs if k in ("src", "href", "srcset", "data")]
        if tag not in ("meta", "link", "img", "br"):
            self._stack.append(tag)

    def handle_endtag(self, tag):
        assert self._stack.pop() == tag

    def handle_data(self, data):
        if self._stack and self._stack[-1] not in ("script", "style"):
            self.text += data


def report(adapt=True, ground_truth=None, points=POINTS, **changes):
    result = FakeCompleter().complete(points, adapt=adapt)
    scan = Scan(points, None, num_not_finite=7, num_outside=11)
    summary = summarize(result, scan, "scan.ply", **(ASKED | {"adapt": adapt}))
    summary["seconds"] = dict(result.seconds)
    if ground_truth is not None:
        summary["scores"] = score(result, ground_truth)
        summary["ground_truth"] = {"file": "gt.ply", "points": len(ground_truth)}
    summary |= changes
    assert isinstance(result, Completed)
    return render_report(result, plain(summary), ground_truth), summary


def test_is_one_file_that_fetches_nothing():
    page, _ = report(ground_truth=POINTS[:100])
    outline = Outline(page)
    assert outline.fetched == []
    assert not {"link", "img", "iframe", "object"} & set(outline.tags)
    assert "@import" not in page.split("</style>")[0]
    assert outline.tags.count("script") >= 5


def test_says_what_result_json_says():
    page, summary = report(ground_truth=POINTS[:100])
    text = Outline(page).text
    assert "300points observed" in text
    assert "150points added" in text
    assert "12.5seconds to compile" in text
    assert "318, of them 7 not finite, 11 outside the workspace and 0 left out" in text
    assert "normal 0.5, denoise 0.25, align 0.25" in text
    assert "the objective went from 1 to 0.5 in 3 steps" in text
    clouds = summary["scores"]["clouds"]
    assert list(clouds) == ["partial", "network", "completed"]
    for name, metrics in clouds.items():
        assert f"{metrics['f_score']:.4g}" in text
        assert name in text


@pytest.mark.parametrize(
    ("adapt", "changes", "verdict"),
    [
        (True, {"accepted": True}, "Adaptation accepted: the objective went from 1"),
        (True, {"accepted": True}, "not that the completion is better"),
        (True, {"accepted": False}, "not accepted: the objective went from 1 to 0.5"),
        (False, {}, "without test-time adaptation, as asked"),
        (True, {"losses": {"objective": [1.0, np.nan]}}, "from 1 to not finite in 1"),
        (False, {"losses": {}}, "without test-time adaptation"),
        (True, {"losses": {"objective": [1.0]}}, "of which these weights take no step"),
    ],
)
def test_verdict(adapt, changes, verdict):
    page, _ = report(adapt, **changes)
    assert verdict in Outline(page).text


def test_ground_truth_is_shown_only_if_given():
    assert "Ground truth: " not in report()[0]
    assert "No ground truth was given" in Outline(report()[0]).text
    assert "Ground truth: 100 points" in report(ground_truth=POINTS[:100])[0]


def test_names_are_escaped():
    name = "</title><script>alert(1)</script>&.ply"
    page, _ = report(
        input={
            "file": name,
            "points_read": 1,
            "points_not_finite": 0,
            "points_outside": 0,
            "points_left_out": 0,
        },
        weights="<b>",
    )
    assert "<script>alert" not in page
    text = Outline(page).text
    assert text.count(name) == 3
    assert "<b>weights" in text


def test_large_clouds_leave_it_under_6_megabytes():
    points = np.random.default_rng(0).normal(size=(60_000, 3))
    page, _ = report(points=points, ground_truth=points)
    assert len(page.encode()) < 6e6
    assert "Partial scan: 60,000 points" in page


def test_viewing_direction_is_near_the_cameras_own():
    camera = Camera.look_at((3, -2, 1), (0, 0, 0))
    toward_viewer, up = viewing_direction(camera)
    np.testing.assert_allclose(np.linalg.norm(toward_viewer), 1, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(up), 1, atol=1e-6)
    toward_camera = np.array([3, -2, 1]) / np.sqrt(14)
    angle = np.rad2deg(np.arccos(toward_viewer @ toward_camera))
    assert 30 < angle < 45
    assert toward_viewer @ up > toward_camera @ up


@pytest.mark.parametrize("up", [[0, 0, 1], [0, -1, 0], [1, 1, 1]])
def test_seen_from_above_there_is_a_way_to_look(up):
    up = np.array(up) / np.linalg.norm(up)
    toward, same = viewing_direction(Camera.look_at(5 * up, np.zeros(3)), up)
    np.testing.assert_allclose(np.linalg.norm(toward), 1, atol=1e-6)
    np.testing.assert_allclose(toward @ up, np.sin(np.deg2rad(20)), atol=1e-6)
    assert same is up


def test_a_scene_has_a_row_for_each_object():
    points = np.random.default_rng(0).uniform(1, 2, (300, 3))
    points[200:] += [10, 0, 0]
    points[:50, 2] = -1
    completer = FakeCompleter()
    taken_apart = completer.split_scene(points)
    scene = completer.complete_scene(points, scene=taken_apart)
    scan = Scan(points, None, 0, 0)
    asked = ASKED | {"adapt": True}
    summary = plain(summarize_scene(scene, scan, "<scan>.ply", **asked))
    page = render_scene_report(scene, summary)
    assert "<h1>&lt;scan&gt;.ply: 2 objects</h1>" in page and "<scan>" not in page
    assert "50 points lie on planes" in page and page.count("<td>unknown</td>") == 4
    assert Outline(page).fetched == []
