"""What a report says of how far a completion can be trusted."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

TRUST = ("unknown", "low", "fair", "high")
"""The lowest first; unknown are completions by weights without a calibration."""

TRUST_COLORS = {
    "unknown": "#6b7280",
    "low": "#b3261e",
    "fair": "#e69f00",
    "high": "#0072b2",
}
"""They differ in lightness too, for readers who tell few hues apart."""

NO_CALIBRATION = "These weights have no calibration: confidence in {what} is unknown."


def trust_of(entry: Mapping[str, Any]) -> str:
    """One of `TRUST`, for an object's entry of result.json."""
    return "unknown" if entry["verdict"] is None else entry["verdict"]["trust"]


def verdict_of_scan(summary: Mapping[str, Any], size: float) -> dict[str, Any]:
    """Headline, sentence and reasons.

    ``size`` is the longest side of what was measured, in the user's units.
    """
    trust, verdict = trust_of(summary), summary["verdict"]
    if verdict is None:
        text = NO_CALIBRATION.format(what="this completion")
        return {
            "trust": trust,
            "headline": "Unknown confidence",
            "text": text,
            "reasons": [],
        }
    error = verdict["expected_error"]
    text = "The expected error is not finite."
    if error is not None:
        share = (
            f", {100 * error / size:.2g} % of the scan's longest side" if size else ""
        )
        text = (
            f"Expected error: {error:.3g} in input units{share}. This is the mean "
            "distance between completed and true surface."
        )
    return {
        "trust": trust,
        "headline": f"{trust.capitalize()} confidence",
        "text": text,
        "reasons": list(verdict["reasons"]) or _nothing_against(trust),
    }


def verdict_of_scene(objects: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """How many objects there are of which trust, the lowest first."""
    count = len(objects)
    headline = f"{count} object{'s' if count != 1 else ''}"
    counts = Counter(map(trust_of, objects))
    lowest = next((trust for trust in TRUST if counts[trust]), "unknown")
    told = [f"{counts[trust]} {trust}" for trust in TRUST if counts[trust]]
    text = f"{', '.join(told)} confidence."
    if count == 0:
        headline, text = "No objects", "Nothing that can be completed was found."
    elif counts["unknown"] == count:
        text = NO_CALIBRATION.format(what="the completions")
    return {"trust": lowest, "headline": headline, "text": text, "reasons": []}


def _nothing_against(trust: str) -> list[str]:
    return ["No evidence speaks against this completion."] if trust == "high" else []
