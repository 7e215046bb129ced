"""The page that leads to the reports of several scans."""

from collections.abc import Mapping, Sequence
from typing import Any

import jinja2

_PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<title>Completed scans</title>
<style>
body { font: 16px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 60rem; }
table { border-collapse: collapse; width: 100%; }
th, td { border-bottom: 1px solid #ccc; padding: .4rem .6rem; text-align: left; }
.number { text-align: right; }
</style>
<h1>{{ results | length }} completed scans</h1>
<table>
<tr><th>scan</th><th class="number">objects</th><th>confidence</th>
<th class="number">observed</th><th class="number">added</th></tr>
{% for name, result in results.items() %}
<tr>
<td><a href="{{ name | urlencode }}/report.html">{{ result.input.file }}</a></td>
<td class="number">{{ result.get("objects", [result]) | length }}</td>
<td>{{ result | trust }}</td>
<td class="number">{{ "{:,}".format(result.points.partial) }}</td>
<td class="number">
{{ "{:,}".format(result.points.completed - result.points.partial) }}</td>
</tr>
{% endfor %}
</table>
{% if failed %}
<h2>Not completed</h2>
<ul>{% for line in failed %}<li>{{ line }}</li>{% endfor %}</ul>
{% endif %}
</html>
"""


def index_page(
    results: Mapping[str, Mapping[str, Any]], failed: Sequence[str] = ()
) -> str:
    """HTML with a row for each result, by the name of the folder that it lies in.

    ``results`` are contents of `result.json`; ``failed`` are lines that say which
    inputs could not be used, and why.
    """
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    environment.filters["trust"] = _trust
    return environment.from_string(_PAGE).render(results=results, failed=failed)


def _trust(result: Mapping[str, Any]) -> str:
    """How many objects have which confidence, the lowest first."""
    objects = result.get("objects", [result])
    words = [(one["verdict"] or {}).get("trust", "unknown") for one in objects]
    counted = {word: words.count(word) for word in ("unknown", "low", "fair", "high")}
    if len(words) == 1:
        return words[0]
    return ", ".join(f"{n} {word}" for word, n in counted.items() if n) or "no objects"
