"""How far a completion can be trusted, from evidence that needs no truth."""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from prism_jax.uncertainty.trees import Trees

EVIDENCE = {
    "num_points": "few points were measured ({:,.0f}): move closer, or scan longer",
    "spacing": "the measured points are sparse: move closer, or scan longer",
    "roughness": "the measured surface is rough or noisy: average several scans",
    "strays": "{:.0%} of the predicted points are outliers: check that the scan "
    "is of one object",
    "in_front": "{:.0%} of the predicted points would occlude measured ones: "
    "set the sensor position (--eye or --camera)",
    "looked_through": "{:.0%} of the predicted points are on lines of sight without "
    "measurements: scan from another side",
    "unexplained": "the completion misses measured points: check --up, and that the "
    "scan is of one object",
    "reach": "most of the object was hidden: scan from another side",
    "disagreement_mirrored": "mirroring the scan changes the completion: check --up, "
    "or scan from another side",
    "disagreement_turned": "a 90 degree rotation changes the completion: check --up, "
    "or scan from another side",
    "novelty": "the scan is unlike the training data: check --up, and that it is of "
    "one object",
}
"""What `prism_jax.uncertainty.evidence.evidence_of` finds, and what to say if it
speaks against a completion, with the remedy."""

SCENE = "this is a scene, not one object: crop it to one with --workspace"
CLOSED = "the cloud is closed all around, and nothing was added: if a side is missing, "
CLOSED += "scan it"

SMALLEST = 1e-3
"""What is added to evidence, shares and lengths, before its logarithm is taken."""

REASON = 0.1
"""Evidence is a reason if the expected error would be less by this much of it, as a
logarithm, were the evidence as usual."""

MAX_REASONS = 3


class Verdict(NamedTuple):
    """What to make of a completed object."""

    trust: Literal["high", "fair", "low"]  # in words
    # The distance, in the user's units, by which completed and true surface are
    # expected to miss each other: CD-L1.
    expected_error: float
    # What speaks against it, each a short sentence with a remedy; empty if nothing
    # does.
    reasons: tuple[str, ...]
    evidence: dict[str, float]  # the numbers that it rests on, by name

    def doubted(self, reason: str) -> "Verdict":
        """The same with low trust for this reason first, whatever the trees say."""
        reasons = (reason, *self.reasons)[:MAX_REASONS]
        return self._replace(trust="low", reasons=reasons)


@dataclasses.dataclass(frozen=True)
class Calibration(Trees):
    """What turns evidence into a verdict: trees over its logarithms, whose sum is the
    logarithm of the error.

    `experiments.calibrate` fits them on validation data that is shifted in every way.
    The global features of training views say what is familiar: their mean, the axes
    along which they vary most, in units of their spread, and the spread of the rest.
    """

    WHAT: ClassVar[str] = "a calibration"
    NAMES: ClassVar[tuple[str, ...]] = tuple(EVIDENCE)

    # The logarithms where completions are good, in the order of `EVIDENCE`.
    usual: Float[np.ndarray, " E"]
    # Expected errors, in half sides of the workspace, from which trust is fair, and
    # low.
    fair: float
    low: float
    # What is familiar.
    feature_mean: Float[np.ndarray, " G"]
    feature_axes: Float[np.ndarray, "A G"]
    feature_rest: float

    @classmethod
    def from_dict(cls, fields: Mapping[str, Any]) -> Any:
        """From what `to_dict` gave; anything else raises ValueError."""
        found = super().from_dict(fields)
        for name in ("fair", "low", "feature_rest"):
            if not getattr(found, name) > 0:
                raise ValueError(f"a calibration's {name} is not positive")
        familiar = found.feature_mean, *found.feature_axes
        if max(np.abs(row).max() for row in familiar) > 1e9:
            raise ValueError("a calibration's features are beyond 1e9")
        if len(found.usual) != len(EVIDENCE):
            raise ValueError(f"a calibration of {len(found.usual)} pieces of evidence")
        return found

    def novelty(self, features: Float[np.ndarray, " G"]) -> float:
        """How far features are from those of the training: 1 is usual there."""
        off = np.asarray(features, np.float64) - self.feature_mean
        along = self.feature_axes @ off
        spread = np.linalg.norm(self.feature_axes, axis=1, keepdims=True)
        units = self.feature_axes / np.maximum(spread, 1e-300)
        rest = off - (units @ off) @ units
        squares = (along**2).sum() + rest @ rest / self.feature_rest**2
        return float(np.sqrt(squares / (len(along) + 1)))

    def expected_error(self, evidence: Mapping[str, float]) -> float:
        """CD-L1 in half sides of the workspace."""
        log_error = self.sums(logarithms(evidence))
        return float(np.exp(np.clip(log_error, *self.bounds)))

    def judge(self, evidence: Mapping[str, float], half_extent: float) -> Verdict:
        """The verdict on an object whose workspace has this half side."""
        found = logarithms(evidence)
        log_error = self.sums(found)
        error = self.expected_error(evidence)
        trust = "low" if error >= self.low else "fair" if error >= self.fair else "high"
        reasons: list[str] = []
        if trust != "high":
            # What the error would be less if one piece of evidence were as usual.
            usual = np.where(np.eye(len(found), dtype=bool), self.usual, found)
            blame = log_error - self.sums(usual)
            told = list(EVIDENCE.items())
            # Few points speak against it, and much of everything else.
            sign = np.array([-1 if name == "num_points" else 1 for name in EVIDENCE])
            blame = np.where(sign * (found - self.usual) > 0, blame, 0.0)
            # No share that would read as 0 %.
            none = [s.startswith("{") and evidence[n] < 0.005 for n, s in told]
            blame[none] = 0.0
            worst = [i for i in np.argsort(-blame, kind="stable") if blame[i] > REASON]
            reasons = [
                told[i][1].format(evidence[told[i][0]]) for i in worst[:MAX_REASONS]
            ]
        return Verdict(trust, error * half_extent, tuple(reasons), dict(evidence))


def logarithms(evidence: Mapping[str, float]) -> Float[np.ndarray, " E"]:
    """Of the evidence, in the order of `EVIDENCE`."""
    return np.log(np.array([evidence[name] for name in EVIDENCE]) + SMALLEST)
