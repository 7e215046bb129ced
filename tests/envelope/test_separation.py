import json

import pytest

from prism_jax.envelope.separation import FORMULAS, read_terms, separation
from prism_jax.io.errors import InputError

TS = {"S_h": 1.6, "S_r": 0.1, "S_s": 0.2, "C": 0.208, "Z_d": 0.05, "Z_r": 0.01}
ISO = {"K": 1.6, "T": 0.5, "D_DS": 0.85, "Z": 0.1}


def written(tmp_path, content):
    path = tmp_path / "terms.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_distances_are_the_standards_sums_with_every_term(tmp_path):
    terms = read_terms(written(tmp_path, {"iso_ts_15066": TS, "iso_13855": ISO}))
    told = separation(terms, margin=0.3)
    both = told["distances"]
    assert both["iso_ts_15066"]["distance"] == pytest.approx(2.168)
    assert both["iso_13855"]["distance"] == pytest.approx(1.6 * 0.5 + 0.85 + 0.1)
    for name, given in (("iso_ts_15066", TS), ("iso_13855", ISO)):
        itemised = both[name]["terms"]
        assert {term["name"]: term["value"] for term in itemised} == given
        assert all(term["source"] and term["meaning"] for term in itemised)


def test_the_inflation_is_told_and_is_in_no_sum(tmp_path):
    terms = read_terms(written(tmp_path, {"iso_ts_15066": TS}))
    with_margin, without = separation(terms, 0.3), separation(terms)
    assert with_margin["distances"] == without["distances"]
    assert with_margin["inflation_of_objects"] == 0.3
    assert "no part of Z_d" in with_margin["inflation_is"]
    assert "Not safety-rated" in with_margin["notice"]


@pytest.mark.parametrize("formula", FORMULAS)
def test_no_term_has_a_default(tmp_path, formula):
    for missing in FORMULAS[formula].terms:
        given = {term: 0.1 for term in FORMULAS[formula].terms if term != missing}
        with pytest.raises(InputError, match=f"missing term {missing} .*no defaults"):
            read_terms(written(tmp_path, {formula: given}))


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("{", "not JSON"),
        ([], "not a JSON object"),
        ({}, "no terms"),
        ({"iso_9999": {}}, "unknown formula"),
        ({"iso_13855": ISO | {"q": 0.3}}, "unknown term 'q'"),
        ({"iso_13855": ISO | {"K": "fast"}}, "a number in m/s"),
        ({"iso_13855": ISO | {"T": -1}}, "a number in s"),
        ('{"iso_13855": {"K": NaN, "T": 1, "D_DS": 0, "Z": 0}}', "K = nan"),
    ],
)
def test_terms_that_are_none_are_refused(tmp_path, content, told):
    with pytest.raises(InputError, match=told):
        read_terms(written(tmp_path, content))
