"""What is made of a prediction, without a network."""

import sys

import numpy as np
from scipy.spatial import KDTree

from prism_jax.adaptation.objective import Losses
from prism_jax.adaptation.test_time import Completion
from prism_jax.completion.assembly import Task, assemble
from prism_jax.completion.options import CompletionOptions
from prism_jax.completion.weights import load_calibration, load_point_errors
from prism_jax.models.config import ModelConfig
from prism_jax.preprocessing.observation import observe
from prism_jax.uncertainty.confidence import CLOSED, SCENE

EYE = np.array([0.0, -4.0, 1.0])


def test_a_completion_builds_ten_trees_at_most(monkeypatch):
    trees = []

    class Counted(KDTree):
        def __init__(self, data, *args, **options):
            trees.append(len(data))
            super().__init__(data, *args, **options)

    for name, module in list(sys.modules.items()):
        if name.startswith("prism_jax") and hasattr(module, "KDTree"):
            monkeypatch.setattr(module, "KDTree", Counted)
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(3000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    seen = observe(ball[ball @ EYE > 1.0], EYE, ModelConfig())
    task = Task(ball[ball @ EYE > 1.0], seen, seen.sampled(512), seen.camera, "given")
    poses = seen.workspace.to_unit(ball) + 0.01 * rng.normal(size=ball.shape)
    calibration, errors = load_calibration("small"), load_point_errors("small")
    losses = Losses(*np.ones((len(Losses._fields), 1)))
    features = np.zeros(len(calibration.feature_mean))
    done = Completion(poses, poses, False, losses, np.ones(3), {}, features)
    judged = assemble(task, done, CompletionOptions(), {}, 3, calibration, errors)
    assert judged.verdict is not None and judged.sigma is not None
    assert not judged.observed.all()
    assert len(trees) <= 10  # three of them small: one of each look
    whole = observe(ball, EYE, ModelConfig())
    task = Task(ball, whole, whole.sampled(512), whole.camera, "given")
    judged = assemble(task, done, CompletionOptions(), {}, 3, calibration, errors)
    assert judged.observed.all() and judged.verdict.reasons == (CLOSED,)
    task = task._replace(points=ball * 100, sensor="given")  # the sensor is amid them
    judged = assemble(task, done, CompletionOptions(), {}, 3, calibration, errors)
    assert judged.verdict.trust == "low" and judged.verdict.reasons[0] == SCENE
