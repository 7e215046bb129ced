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


def trust_of_all(summary: Mapping[str, Any]) -> str:
    """How many objects of a result have which trust, the lowest first; of a single one
    the trust alone."""
    objects = summary.get("objects", [summary])
    return trust_of(objects[0]) if len(objects) == 1 else _counted(objects)


def _counted(objects: Sequence[Mapping[str, Any]]) -> str:
    counts = Counter(map(trust_of, objects))
    told = [f"{counts[trust]} {trust}" for trust in TRUST if counts[trust]]
    return ", ".join(told) or "no objects"


def verdict_of_scan(summary: Mapping[str, Any], size: float) -> dict[str, Any]:
    """Headline, sentence and reasons. ``size`` is the longest side of what was
    measured, in the user's units."""
    trust, verdict = trust_of(summary), summary["verdict"]
    if verdict is None:
        text, reasons = NO_CALIBRATION.format(what="this completion"), []
    else:
        error, reasons = verdict["expected_error"], list(verdict["reasons"])
        text = "The expected error is not finite."
        if error is not None:
            share = f", {100 * error / size:.2g} % of the" if size else ""
            side = " scan's longest side" if size else ""
            text = (
                f"Expected error: {error:.3g} in input units{share}{side}. This is the "
                "mean distance between completed and true surface."
            )
        if trust == "high" and not reasons:
            reasons = ["No evidence speaks against this completion."]
    headline = f"{trust.capitalize()} confidence"
    return {"trust": trust, "headline": headline, "text": text, "reasons": reasons}


def verdict_of_scene(objects: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """How many objects there are of which trust, the lowest first."""
    count = len(objects)
    headline = f"{count} object{'s' if count != 1 else ''}"
    trusts = set(map(trust_of, objects))
    lowest = next((trust for trust in TRUST if trust in trusts), "unknown")
    text = f"{_counted(objects)} confidence."
    if count == 0:
        headline, text = "No objects", "Nothing that can be completed was found."
    elif trusts == {"unknown"}:
        text = NO_CALIBRATION.format(what="the completions")
    return {"trust": lowest, "headline": headline, "text": text, "reasons": []}
