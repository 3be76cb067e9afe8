"""Cost of verdicts and of plans against the number of parts, from the records of `benchmarks/scaling.py`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from palette import INK, ROBOTS

DATA = Path(__file__).resolve().parents[2] / "benchmarks" / "results" / "scaling.jsonl"
SERIES = {
    "contacts_s": "contacts",
    "problem_s": "problem",
    "equilibrium_s": "verdict with proof, equilibrium",
    "contact_s": "verdict with proof, contact",
    "next_s": "verdict of a next state, contact",
}


def cost_against_parts(path: Path) -> None:
    """Draw seconds over parts on logarithmic axes with fitted lines."""
    records = _records()
    fit = [record for record in records if record["benchmark"] == "scaling fit"][-1]
    sizes = [one for one in records if one["benchmark"] == "scaling" and one["commit"] == fit["commit"]]
    parts = np.array([size["parts"] for size in sizes], dtype=float)
    figure, axes = plt.subplots(figsize=(7, 4.2), layout="constrained")
    for (name, label), colour in zip(SERIES.items(), ROBOTS, strict=False):
        seconds = np.array([size[name] for size in sizes])
        exponent = fit["exponent"][name]
        level = np.exp(np.mean(np.log(seconds) - exponent * np.log(parts)))
        axes.loglog(parts, level * parts**exponent, color=colour, linewidth=1)
        axes.loglog(parts, seconds, "o", color=colour, label=f"{label}: parts$^{{{exponent:.2f}}}$")
    _save(figure, axes, path, [size["parts"] for size in sizes], f"processor seconds, {fit['device']}")


def planning_against_parts(path: Path) -> None:
    """Draw processor seconds to a plan with two robots over parts, logarithmically, and lines through three sizes."""
    records = _records()
    figure, axes = plt.subplots(figsize=(7, 4.2), layout="constrained")
    plans = [record for record in records if record["benchmark"] == "scaling plan" and record["robots"] == 2]
    newest = {(plan["criterion"], plan["parts"]): plan["commit"] for plan in plans}
    plans = [plan for plan in plans if plan["commit"] == newest[plan["criterion"], plan["parts"]]]
    for criterion, colour in zip(("contact", "equilibrium"), ROBOTS, strict=False):
        mine = [plan for plan in plans if plan["criterion"] == criterion]
        found = [plan for plan in mine if plan["found"]]
        parts, seconds = (np.array([plan[key] for plan in found], dtype=float) for key in ("parts", "plan_s"))
        label = f"{criterion}, {mine[-1]['device']}"
        if len(set(parts.tolist())) > 2:
            exponent, level = np.polyfit(np.log(parts), np.log(seconds), 1)
            label = f"{label}: parts$^{{{exponent:.2f}}}$"
            axes.loglog(parts, np.exp(level) * parts**exponent, color=colour, linewidth=1)
        axes.loglog(parts, seconds, "o", color=colour, label=label)
        for plan in mine:
            if not plan["found"]:
                axes.loglog(plan["parts"], plan["plan_s"], "^", color=colour, fillstyle="none")
    if not all(plan["found"] for plan in plans):
        axes.loglog([], [], "^", color=INK, fillstyle="none", label="no plan by then")
    ticks = sorted({plan["parts"] for plan in plans})
    _save(figure, axes, path, ticks, "processor seconds to a proven plan")


def _records() -> list[dict[str, Any]]:
    return [json.loads(line) for line in DATA.read_text(encoding="utf-8").splitlines()]


def _save(figure: Figure, axes: Axes, path: Path, parts: list[int], what: str) -> None:
    """Label the axes and write the picture."""
    axes.set_xticks(parts, [str(value) for value in parts], minor=False)
    axes.minorticks_off()
    axes.set_xlabel("parts of the built-in vault", color=INK)
    axes.set_ylabel(what, color=INK)
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)
