"""How far a completion can be trusted, from evidence that needs no truth."""

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

EVIDENCE = {
    "num_points": "few points were measured ({:,.0f}): come closer, or scan longer",
    "spacing": "what was measured is spread thinly: crop to one object",
    "roughness": "the measured surface is rough or noisy: average several scans",
    "strays": "{:.0%} of the predicted points stray: crop to one object",
    "in_front": "{:.0%} of the predicted points would have hidden what was measured: "
    "say where the sensor stood (--camera)",
    "looked_through": "{:.0%} of the predicted points are where nothing was measured "
    "about their line of sight: crop to one object, or scan from another side",
    "unexplained": "the completion misses measured points: crop to one object, and "
    "check --up",
    "reach": "most of it was hidden: scan from another side",
    "disagreement_mirrored": "its mirror image is completed otherwise: check --up, or "
    "scan from another side",
    "disagreement_turned": "turned by a quarter it is completed otherwise: check --up, "
    "or scan from another side",
    "novelty": "it looks unlike what the weights were trained on: crop to one object, "
    "and check --up",
}
"""What `prism_jax.evidence.evidence_of` finds, and what to say if it speaks against a
completion, with the remedy."""

SMALLEST = 1e-3
"""What is added to evidence, shares and lengths, before its logarithm is taken."""

REASON = 0.1
"""Evidence is a reason if the expected error would be less by this much of it, as a
logarithm, were the evidence as usual."""

MAX_REASONS = 3


class Verdict(NamedTuple):
    """What to make of a completed object.

    Attributes:
      trust: in words.
      expected_error: the distance, in the user's units, by which completed and true
        surface are expected to miss each other: CD-L1.
      reasons: what speaks against it, each a short sentence with a remedy; empty if
        nothing does.
      evidence: the numbers that it rests on, by name.
    """

    trust: Literal["high", "fair", "low"]
    expected_error: float
    reasons: tuple[str, ...]
    evidence: dict[str, float]


@dataclasses.dataclass(frozen=True)
class Calibration:
    """What turns evidence into a verdict: the sum of small decision trees over its
    logarithms.

    Each tree is complete: node n splits into 2 n + 1, where the logarithm that it looks
    at is at most its threshold, and 2 n + 2. `experiments.trust` fits them on
    validation data that is shifted in every way. The global features of training views
    say what is familiar: their mean, the axes along which they vary most, in units of
    their spread, and the spread of what is left.

    Attributes:
      usual: the logarithms where completions are good, in the order of `EVIDENCE`.
      base: the logarithm of the error that the trees' sum is added to.
      looks_at: which piece of evidence each node of each tree looks at.
      thresholds: of its logarithm.
      leaves: what each leaf adds.
      bounds: the least and the largest logarithm of an error that was met.
      fair, low: expected errors, in half sides of the workspace, from which trust is
        fair, and low.
      feature_mean, feature_axes, feature_rest: what is familiar.
    """

    usual: Float[np.ndarray, " E"]
    base: float
    looks_at: Float[np.ndarray, "T N"]
    thresholds: Float[np.ndarray, "T N"]
    leaves: Float[np.ndarray, "T L"]
    bounds: Float[np.ndarray, "2"]
    fair: float
    low: float
    feature_mean: Float[np.ndarray, " G"]
    feature_axes: Float[np.ndarray, "A G"]
    feature_rest: float

    @classmethod
    def from_dict(cls, fields: Mapping[str, Any]) -> "Calibration":
        """From what `to_dict` gave; anything else raises ValueError."""
        names = [field.name for field in dataclasses.fields(cls)]
        if not isinstance(fields, Mapping) or set(fields) != set(names):
            raise ValueError(f"a calibration has {', '.join(names)}")
        try:
            arrays = {name: np.asarray(fields[name], np.float64) for name in names}
        except (TypeError, ValueError) as error:
            raise ValueError(f"a calibration is made of numbers: {error}") from None
        count = len(EVIDENCE)
        width = arrays["feature_mean"].shape
        trees, nodes = (*arrays["looks_at"].shape, 0, 0)[:2]
        shapes = {
            "usual": (count,),
            "looks_at": (trees, 2 ** (nodes + 1).bit_length() // 2 - 1),
            "thresholds": (trees, nodes),
            "leaves": (trees, nodes + 1),
            "bounds": (2,),
            "feature_axes": (arrays["feature_axes"].shape[:1] + width),
            **dict.fromkeys(("base", "fair", "low", "feature_rest"), ()),
        }
        for name, array in arrays.items():
            if array.shape != shapes.get(name, (array.size,)):
                raise ValueError(f"a calibration's {name} has the shape {array.shape}")
            if not np.isfinite(array).all():
                raise ValueError(f"a calibration's {name} is not finite")
        if not np.isin(arrays["looks_at"], np.arange(count)).all():
            raise ValueError("a calibration's looks_at is beyond the evidence")
        for name in ("fair", "low", "feature_rest"):
            if not (arrays[name] > 0).all():
                raise ValueError(f"a calibration's {name} is not positive")
        plain: dict[str, Any] = {
            name: float(array) if array.ndim == 0 else array
            for name, array in arrays.items()
        }
        return cls(**plain)

    def to_dict(self) -> dict[str, Any]:
        """Lists and numbers, six digits of each."""
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return {name: _short(value) for name, value in fields.items()}

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
        found = logarithms(evidence)
        return float(np.exp(np.clip(self._log_error(found), *self.bounds)))

    def judge(self, evidence: Mapping[str, float], half_extent: float) -> Verdict:
        """The verdict on an object whose workspace has this half side."""
        found = logarithms(evidence)
        log_error = self._log_error(found)
        error = self.expected_error(evidence)
        trust = "low" if error >= self.low else "fair" if error >= self.fair else "high"
        reasons: list[str] = []
        if trust != "high":
            # What the error would be less if one piece of evidence were as usual.
            usual = np.where(np.eye(len(found), dtype=bool), self.usual, found)
            blame = log_error - np.array([self._log_error(row) for row in usual])
            worst = [i for i in np.argsort(-blame, kind="stable") if blame[i] > REASON]
            told = list(EVIDENCE.items())
            reasons = [
                told[i][1].format(evidence[told[i][0]]) for i in worst[:MAX_REASONS]
            ]
        return Verdict(trust, error * half_extent, tuple(reasons), dict(evidence))

    def _log_error(self, found: Float[np.ndarray, " E"]) -> float:
        """Beyond what was met, too."""
        trees, nodes = self.looks_at.shape
        rows, node = np.arange(trees), np.zeros(trees, int)
        while nodes and node[0] < nodes:
            seen = found[self.looks_at[rows, node].astype(int)]
            node = 2 * node + 1 + (seen > self.thresholds[rows, node])
        return float(self.base + self.leaves[rows, node - nodes].sum())


def logarithms(evidence: Mapping[str, float]) -> Float[np.ndarray, " E"]:
    """Of the evidence, in the order of `EVIDENCE`."""
    return np.log(np.array([evidence[name] for name in EVIDENCE]) + SMALLEST)


def _short(value: Any) -> Any:
    digits = np.vectorize(lambda number: float(f"{number:.6g}"))
    return digits(np.asarray(value, np.float64)).tolist()
