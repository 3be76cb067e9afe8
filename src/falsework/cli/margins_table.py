"""Part of `falsework margins`: the margins of states as a table, the weakest first."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from falsework.utils.quantity import format_quantity

if TYPE_CHECKING:
    from falsework.cli.output import Output

SHOWN = 12
"""Largest number of steps of a plan that are printed unless all are asked for."""
_COLUMNS = (
    ("friction", "friction needed", "factor", 1.0),
    ("tilt_deg", "tilt", "angle", 0.017453292519943295),
    ("horizontal_g", "horizontal", "share of gravity", 1.0),
    ("load_factor", "weight of a part, times", "factor", 1.0),
    ("total_load_factor", "all weights, times", "factor", 1.0),
    ("push_n", "push", "force", 1.0),
)
"""Margins with their headings, kinds of quantity, and sizes of their units in SI units."""
_MARK = "*"
"""After the weakest margin of each kind."""


def print_margins(
    records: list[dict[str, Any]], subjects: list[str], output: Output, *, everything: bool = False
) -> None:
    """Print the margins of states, those of one below each other, those of several as a table with the weakest first.

    The states with the weakest margin of a kind come first; of the others a state comes the earlier, the nearer one of
    its margins is to the weakest.
    """
    weakest = {key: _weakest([record[key] for record in records], key) for key, *_ in _COLUMNS}
    if len(records) > 1:
        output.record(
            {
                "weakest": [
                    {"margin": k, "state": i, "value": records[i][k]} for k, i in weakest.items() if i is not None
                ]
            }
        )
    if len(records) == 1:
        output.say(f"{subjects[0]}:")
        output.table(("margin", "bound"), _single(records[0]))
        return
    best = {key: None if i is None else records[i][key] for key, i in weakest.items()}
    marked = set(weakest.values())
    ratios = [min(_ratio(record, key, best[key]) for key in best) for record in records]
    order = sorted(range(len(records)), key=lambda i: (i not in marked, ratios[i]))
    shown = order if everything else order[:SHOWN]
    headings = ("state", *(title for _, title, *_ in _COLUMNS), "heaviest hold", "remarks")
    rows = []
    for i in shown:
        record = records[i]
        cells = [_cell(record, *column) + _MARK * (weakest[column[0]] == i) for column in _COLUMNS]
        loads = sorted(record["held"], key=lambda load: -load["force_n"])
        hold = f"{loads[0]['name']} {format_quantity(loads[0]['force_n'], 'force')}" if loads else ""
        rows.append((subjects[i], *cells, hold, "; ".join(_remarks(record))))
    used = [column for column, title in enumerate(headings) if column == 0 or any(row[column] for row in rows)]
    output.table([headings[k] for k in used], [[row[k] for k in used] for row in rows])
    output.say(f"{_MARK} weakest of all {len(records)} states")
    if len(shown) < len(records):
        output.say(f"{len(records) - len(shown)} stronger states are left out; --steps prints them too")


def _weakest(values: list[float | None], key: str) -> int | None:
    """Return the state with the least margin; None if no state has a bound."""
    given = [(value, i) for i, value in enumerate(values) if value is not None]
    if not given:
        return None
    return (max(given, key=lambda entry: entry[0]) if key == "friction" else min(given))[1]


def _ratio(record: dict[str, Any], key: str, weakest: float | None) -> float:
    """Return how many times stronger than the weakest a margin is."""
    value = record[key]
    if weakest is None or value is None:
        return float("inf")
    weak, strong = (value, weakest) if key == "friction" else (weakest, value)
    return 1.0 if strong == weak else float("inf") if weak == 0.0 else strong / weak


def _cell(record: dict[str, Any], key: str, title: str, kind: str, scale: float) -> str:
    return "" if record[key] is None else format_quantity(record[key] * scale, kind)


def _single(record: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the margins of one state, a row each."""
    rows = [(column[1], _cell(record, *column) or "no bound") for column in _COLUMNS]
    if record["push_name"] is not None:
        rows[-1] = (rows[-1][0], f"{rows[-1][1]} on {record['push_name']}")
    for load in record["held"]:
        force, moment = format_quantity(load["force_n"], "force"), format_quantity(load["moment_nm"], "moment")
        rows.append((f"hold of {load['name']}", f"{force}, {moment}"))
    return [*rows, *(("", remark) for remark in _remarks(record))]


def _remarks(record: dict[str, Any]) -> list[str]:
    words = [] if record["stands"] else ["does not stand from rest"]
    for name, depth in record.get("settlement_m", {}).items():
        deep = "as far as the criterion allows" if depth is None else format_quantity(depth, "length")
        words.append(f"{name} may sink {deep}")
    for entry in record.get("placement", []):
        words.append(f"{entry['share']:.1%} stand placed within {format_quantity(entry['error_m'], 'length')}")
    if record.get("unfinished"):
        words.append(f"{', '.join(record['unfinished'])} cut short by the deadline")
    elif not record["proven"]:
        words.append("not proven on both sides")
    if not record["monotone"]:
        words.append("a condition further inside fails")
    return words
