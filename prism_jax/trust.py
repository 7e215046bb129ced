"""How far a completion can be trusted, from evidence that needs no truth."""

from typing import Literal, NamedTuple


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
