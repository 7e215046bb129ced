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

NO_CALIBRATION = "These weights come without a calibration: nothing vouches for {what}."


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
        return {"trust": trust, "headline": "No verdict", "text": text, "reasons": []}
    error = verdict["expected_error"]
    text = "The expected error is not a finite number."
    if error is not None:
        share = (
            f", {100 * error / size:.2g} % of the scan's longest side" if size else ""
        )
        text = (
            f"Completed and true surface are expected to lie {error:.3g} apart on "
            f"average, in the input's units{share}."
        )
    return {
        "trust": trust,
        "headline": f"{trust.capitalize()} trust",
        "text": text,
        "reasons": list(verdict["reasons"]) or _nothing_against(trust),
    }


def verdict_of_scene(objects: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """How many objects there are of which trust, the lowest first."""
    count = len(objects)
    headline = f"{count} object{'s' if count != 1 else ''}"
    counts = Counter(map(trust_of, objects))
    lowest = next((trust for trust in TRUST if counts[trust]), "unknown")
    told = [f"{counts[trust]} of {trust}" for trust in TRUST if counts[trust]]
    text = f"{', '.join(told)} trust."
    if count == 0:
        headline, text = "No object", "Nothing was found that could be completed."
    elif counts["unknown"] == count:
        text = NO_CALIBRATION.format(what="a completion")
    return {"trust": lowest, "headline": headline, "text": text, "reasons": []}


def _nothing_against(trust: str) -> list[str]:
    return ["Nothing in the evidence speaks against it."] if trust == "high" else []
