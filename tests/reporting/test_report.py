"""The report: one file, true to result.json, that fetches nothing."""

import dataclasses
import html
import json
import re

import numpy as np
import pytest

from prism_jax.geometry.workspace import Workspace
from prism_jax.io import Scan
from prism_jax.reporting import render_report, render_scene_report
from prism_jax.reporting.summary import plain, score, summarize, summarize_scene
from prism_jax.reporting.view import shown_bounds
from prism_jax.uncertainty.confidence import Verdict
from tests.fake_completer import FakeCompleter

POINTS = np.random.default_rng(0).normal(size=(300, 3)).astype(np.float32)

ASKED = {"weights": "small", "up": "z", "bounds": None, "density": 1.0}

LOW = Verdict("low", 0.0321, ("<Few> points: come closer.",), {"num_points": 99.0})
FAIR = Verdict("fair", 0.05 * 10 * np.ptp(POINTS[:, 2]), (), {})
UNSEEN = ("precision_2", "recall_2", "f_2")
HIGH = Verdict("high", 0.00123, (), {"strays": 0.5})


def without_scripts(page):
    return re.sub(r"(?s)<(script|style)\b.*?</\1>", "", page)


def text_of(page):
    """What is read, outside of tags, scripts and styles."""
    return html.unescape(re.sub(r"<[^>]*>", "", without_scripts(page)))


def fetched(page):
    """What tags would fetch."""
    tags = re.findall(r"<[^>]*\s(?:src|href|srcset|data)=", without_scripts(page))
    return tags + re.findall(r"<(?:script|link|iframe|object)\s[^>]*\bsrc=", page)


def report(
    adapt=True, ground_truth=None, points=POINTS, verdict=None, sigma=None, **changes
):
    result = FakeCompleter().complete(points, adapt=adapt)
    sigma = None if sigma is None else np.where(result.observed, 0.0, sigma)
    result = dataclasses.replace(result, verdict=verdict, sigma=sigma)
    scan = Scan(points, None, num_not_finite=7, num_outside=11)
    summary = summarize(result, scan, "scan.ply", **(ASKED | {"adapt": adapt}))
    summary["seconds"] = dict(result.seconds)
    if ground_truth is not None:
        summary["scores"] = score(result, ground_truth)
        summary["ground_truth"] = {"file": "gt.ply", "points": len(ground_truth)}
    summary |= changes
    return render_report(result, plain(summary), ground_truth), summary


def test_is_one_file_that_says_what_result_json_says_and_fetches_nothing():
    page, summary = report(ground_truth=POINTS[:100] * [1, 1, 1.3])
    assert fetched(page) == []
    assert "@import" not in page.split("</style>")[0]
    text, scores = text_of(page), summary["scores"]
    for said in (
        "300 points observed, 150 added, weights small",
        "compile 12.50, run 0.25",
        "1 outliers, 2 in front of measured points, 3 where points were",
        "318, of which 7 not finite, 11 outside the workspace and 0 removed",
        "normal 0.5, denoise 0.25, align 0.25",
        "the objective changed from 1 to 0.5 in 3 steps",
        "Scores against",
        *(f"{scores['clouds']['completed'][name]:.4g}" for name in UNSEEN),
    ):
        assert said in text
    assert "Ground truth: 100 points" in page


@pytest.mark.parametrize(
    ("verdict", "headline", "said"),
    [
        (LOW, "Low confidence", "<Few> points: come closer."),
        (FAIR, "Fair confidence", "Expected error: 2.72 in input units, 5 % of the"),
        (HIGH, "High confidence", "No evidence speaks against this completion."),
        (HIGH._replace(expected_error=np.inf), "High confidence", "is not finite"),
        (None, "Unknown confidence", "confidence in this completion is unknown"),
    ],
)
def test_opens_with_the_verdict(verdict, headline, said):
    text = text_of(report(points=POINTS * [1, 1, 10], verdict=verdict)[0])
    assert text.split("scan.ply completed by prism_jax")[1].strip().startswith(headline)
    assert said in text


@pytest.mark.parametrize(
    ("adapt", "changes", "said"),
    [
        (True, {"accepted": False}, "rejected: the objective changed from 1 to 0.5"),
        (True, {"losses": {"objective": [1.0, np.nan]}}, "from 1 to not finite in 1"),
        (False, {"losses": {}}, "off\nNetwork output"),
        (True, {"losses": {}}, "off: these weights use no"),
    ],
)
def test_details_say_what_became_of_the_adaptation(adapt, changes, said):
    page = report(adapt, **changes)[0]
    assert said in text_of(page).split("Adaptation")[1]
    # Of errors and the truth there is nothing.
    assert "these weights do not estimate it" in text_of(page)
    assert 'data-colors="' not in page and "Scores against" not in page


def test_names_are_escaped():
    name = "</title><script>alert(1)</script>&.ply"
    counts = ("read", "not_finite", "outside", "left_out")
    about = {"file": name, **{f"points_{count}": 1 for count in counts}}
    page, _ = report(input=about, weights="<b>")
    assert "<script>alert" not in page
    text = text_of(page)
    assert text.count(name) == 3
    assert "weights <b>." in text


def test_large_clouds_leave_it_under_6_megabytes():
    points = np.random.default_rng(0).normal(size=(60_000, 3))
    page, _ = report(points=points, ground_truth=points)
    assert len(page.encode()) < 6e6
    assert "Partial scan: 60,000 points" in page


def test_strays_do_not_make_an_object_small():
    measured = np.random.default_rng(0).uniform(-0.5, 0.5, (500, 3)) * [1, 1, 0]
    added = np.random.default_rng(1).uniform(-0.5, 0.5, (1000, 3))
    few = np.concatenate([added, [[0, 0, 0.9], [-0.9, 0, 0]]])
    lower, upper = shown_bounds(measured, few, Workspace.unit())
    assert (lower > -0.51).all() and (upper < 0.51).all()
    assert lower[2] < -0.48 and upper[2] > 0.48
    many = np.concatenate([added, np.full((500, 3), 23.0)])
    assert shown_bounds(measured, many, Workspace.unit())[1].tolist() == [1, 1, 1]
    nothing = shown_bounds(measured, measured[:0], Workspace.unit())
    np.testing.assert_array_equal(nothing, [measured.min(0), measured.max(0)])


def errors_of(page):
    figure = page.split("Plotly.newPlot")[1]
    found = re.findall(r'"error":\[([^\]]*)\]', figure)
    return [[float(number) for number in numbers.split(",")] for numbers in found]


def test_added_points_can_be_coloured_by_their_errors():
    """Up to the bulk of them; the measured ones are grey."""
    page, summary = report(sigma=np.linspace(0.1, 0.3, 450), ground_truth=POINTS[:9])
    assert page.count('data-colors="error"') == 1
    assert '"cmax":0.29' in page.replace(" ", "")
    (numbers,) = errors_of(page)
    assert len(numbers) == 150 and 0.2 < numbers[0] < numbers[-1] <= 0.3
    said = f"median {summary['sigma']['median']:.4g}, 5th to 95th percentile"
    assert said in text_of(page)


def scene_report(verdicts, stray=None, name="<scan>.ply", error=None):
    """Of objects in a row on a plane, one for each verdict."""

    def with_error(one, **changes):
        sigma = None if error is None else np.where(one.observed, 0.0, error)
        return dataclasses.replace(one, sigma=sigma, **changes)

    points = np.random.default_rng(0).uniform(1, 2, (100 * len(verdicts) + 50, 3))
    points[:, 0] += 10 * (np.arange(len(points)) // 100)
    points[-50:] *= [0, 1, -1]
    completer = FakeCompleter()
    taken_apart = completer.split_scene(points)
    scene = completer.complete_scene(points, scene=taken_apart, adapt=True)
    pairs = zip(scene.objects, verdicts, strict=True)
    objects = tuple(with_error(one, verdict=verdict) for one, verdict in pairs)
    scene = with_error(scene, objects=objects)
    if stray is not None:
        scene.points[-1] = scene.objects[-1].points[-1] = stray
    asked = ASKED | {"adapt": True}
    summary = summarize_scene(scene, Scan(points, None, 0, 0), name, **asked)
    return render_scene_report(scene, plain(summary | {"seconds": {"run": 1.0}}))


def boxes_of(page):
    return json.loads(re.search(r"const boxes = (.*);", page)[1])


def test_a_scene_opens_with_how_many_objects_of_which_trust_and_lists_them():
    page = scene_report([HIGH, LOW, HIGH, FAIR])
    text = text_of(page)
    assert "4 objects\n1 low, 1 fair, 2 high confidence." in text
    assert fetched(page) == [] and "<scan>" not in page
    rows = re.findall(r"(\d)\n(low|high|fair)\n(\d+)(\d{2})\n([\d.]+)", text)
    assert rows[0] == ("0", "high", "100", "50", "0.00123")
    assert rows[1] == ("1", "low", "100", "50", "0.0321")
    assert "<Few> points: come closer." in text and "50 on the support" in text


@pytest.mark.parametrize(
    ("verdicts", "said"),
    [
        ([None, None], "2 objects\nThese weights have no calibration"),
        ([None, HIGH], "2 objects\n1 unknown, 1 high confidence."),
        ([], "No objects\nNothing that can be completed was found."),
    ],
)
def test_a_scene_says_whose_trust_is_not_known(verdicts, said):
    assert said in text_of(scene_report(verdicts))


def test_every_object_of_a_scene_can_be_shown_alone():
    page = scene_report([HIGH, LOW])
    everything, *alone = boxes_of(page)
    for number, box in enumerate(alone):
        first, last = box["scene.xaxis.range"]
        assert 10 * number < first < 10 * number + 1.1
        assert 10 * number + 1.9 < last < 10 * number + 3
    first, last = everything["scene.xaxis.range"]
    assert len(alone) == 2 and first < 1 and last > 12
    assert page.count('<button type="button" data-object=') == 3
    # A stray does not make a scene small.
    assert boxes_of(scene_report([HIGH, LOW], stray=1e3))[0] == everything


def test_a_scene_can_be_coloured_by_trust_and_by_errors():
    page = scene_report([HIGH, LOW], error=0.25)
    assert re.findall(r'data-colors="(\w+)"', page) == ["trust", "error"]
    assert [set(found) for found in errors_of(page)] == [{0.25}] * 2
    assert "median 0.25, 5th to 95th percentile" in text_of(page)
