"""Protective separation distances, put together from terms that the user gives.

Nothing here is a default, and nothing of it is measured: every term is a number that
someone answers for, and the sum is itemised with what each term is. The margin of an
envelope is no part of it: that inflates objects, and is told apart.
"""

import math
import os
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from prism_jax.envelope import NOTICE
from prism_jax.io.errors import InputError
from prism_jax.io.files import read_json


class Term(NamedTuple):
    """What a term is, its unit, and where the standard has it."""

    meaning: str
    unit: str
    source: str


class Formula(NamedTuple):
    """A separation distance: its standard, how it is written, its terms, their sum."""

    standard: str
    written: str
    terms: Mapping[str, Term]
    distance: Callable[[Mapping[str, float]], float]


_TS = "ISO/TS 15066:2016, 5.5.4.2.3; ISO 10218-2:2025"
_DETECTION = "ISO 13855:2024"

FORMULAS: Mapping[str, Formula] = {
    "iso_ts_15066": Formula(
        standard="ISO/TS 15066:2016, now in ISO 10218-2:2025",
        written="S_p = S_h + S_r + S_s + C + Z_d + Z_r",
        terms={
            "S_h": Term("what a person moves until the robot has stopped", "m", _TS),
            "S_r": Term("what the robot moves until it starts to stop", "m", _TS),
            "S_s": Term("what the robot moves while it stops", "m", _TS),
            "C": Term("how far a part of the body reaches in undetected", "m", _TS),
            "Z_d": Term(
                "how uncertain a person's position is as the sensor measures it",
                "m",
                _TS,
            ),
            "Z_r": Term("how uncertain the robot's position is", "m", _TS),
        },
        distance=lambda t: math.fsum(t.values()),
    ),
    "iso_13855": Formula(
        standard="ISO 13855:2024",
        written="S = K T + D_DS + Z",
        terms={
            "K": Term("the speed at which a person approaches", "m/s", _DETECTION),
            "T": Term("the time that the whole system takes to stop", "s", _DETECTION),
            "D_DS": Term(
                "how far one reaches towards the hazard before being detected",
                "m",
                _DETECTION,
            ),
            "Z": Term("supplements for measuring and positions", "m", _DETECTION),
        },
        distance=lambda t: math.fsum([t["K"] * t["T"], t["D_DS"], t["Z"]]),
    ),
}
"""By their names in the file of terms."""

_LAYOUT = (
    'write {"iso_ts_15066": {"S_h":, "S_r":, "S_s":, "C":, "Z_d":, "Z_r":}} in metres, '
    'or {"iso_13855": {"K":, "T":, "D_DS":, "Z":}} in m/s, s and metres, or both'
)


def read_terms(path: str | os.PathLike) -> dict[str, dict[str, float]]:
    """The terms of each formula that a JSON file gives.

    Every term of it must be there, a finite number from 0 on, and no other; else
    InputError, as for a file without any formula.
    """
    content = read_json(path, _LAYOUT)
    if not content:
        raise InputError(path, "no terms", _LAYOUT)
    return {name: _checked(path, name, terms) for name, terms in content.items()}


def separation(
    terms: Mapping[str, Mapping[str, float]], margin: float | None = None
) -> dict[str, Any]:
    """The distances with every term itemised, as JSON has it; metres.

    `terms` are of `read_terms`. `margin` is that of the envelope whose distances they
    are to be compared with: it is told beside them and is in no sum.
    """
    told = {}
    for name, given in terms.items():
        formula = FORMULAS[name]
        told[name] = {
            "standard": formula.standard,
            "formula": formula.written,
            "terms": [
                {"name": term, "value": given[term], **about._asdict()}
                for term, about in formula.terms.items()
            ],
            "distance": formula.distance(given),
        }
    return {
        "notice": NOTICE,
        "distances": told,
        "inflation_of_objects": margin,
        "inflation_is": "q of the calibration; in no term, and no part of Z_d",
    }


def _checked(path: str | os.PathLike, name: str, terms: Any) -> dict[str, float]:
    if name not in FORMULAS:
        raise InputError(path, f"unknown formula {name!r}", _LAYOUT)
    wanted = FORMULAS[name].terms
    if type(terms) is not dict:
        raise InputError(path, f"no terms of {name}", _LAYOUT)
    for term in wanted.keys() - terms.keys():
        fault = f"missing term {term} of {name}: {wanted[term].meaning}"
        raise InputError(path, fault, "set it; terms have no defaults")
    for term in terms.keys() - wanted.keys():
        fault = f"unknown term {term!r} of {name}"
        raise InputError(path, fault, f"use {', '.join(wanted)}")
    for term, value in terms.items():
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not 0.0 <= value <= 1e6:
            fault = f"invalid {term} = {value!r} of {name}"
            raise InputError(path, fault, f"give a number in {wanted[term].unit}")
    return {term: float(terms[term]) for term in wanted}
