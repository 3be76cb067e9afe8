"""Structures that others published load as they are, and the joints found agree with those that their files store."""

from __future__ import annotations

import json
import warnings
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from falsework import Assembly, StabilityOracle, StabilitySettings, load_structure
from falsework.assembly import complete_state
from tests.conftest import data_folder

FOLDERS = {
    **dict.fromkeys(("cra-A", "cra-H", "cra-cubes"), 2),
    **dict.fromkeys(("cra-concave-long", "cra-concave-short", "cra-cube-curve-short", "cra-cube-curve-tall"), 1),
    **dict.fromkeys(("cra-type-a", "cra-type-b", "cra-type-c", "cra-type-d", "cra-snake"), 3),
    "cra-bridge": 21,
    "cra-shelf": 18,
    "cra-shelf-s1": 21,
    "cra-shelf-s2": 19,
    "cra-shelf-s3": 19,
    "cra-shelf-stable": 14,
    "arch-30": 29,
    "barrel-vault-121": 320,
    "crossvault-184": 452,
    "dem-crossvault-38": 60,
    "nurbs-wall-52": 80,
    "topolite-tube-85": 252,
    "wall-38": 60,
}
"""Pairs of parts that touch in models whose faces are exact."""
INEXACT = {
    "armadillo-399": (1047, 0.04),
    "armadillo-399-cra": (1043, 0.04),
    "pavilion-vault-387": (1146, 0.01),
    "dome-90": (250, 0.01),
    "ursula-6": (5, 0.06),
    "genevault-110": (250, 0.3),
    "cra-curve-3-blocks": (2, 0.01),
}
"""Pairs of parts that touch, and a bound for the largest overlap, metres, in models with overlaps."""


def folder_of(name: str) -> Path:
    data = data_folder()
    if data is None or not (data / "structures" / name).exists():
        pytest.skip("public structures not found: set FALSEWORK_DATA to the folder that holds structures/")
    return data / "structures" / name


@cache
def load(name: str) -> tuple[Assembly, list[str]]:
    """A structure, and the warnings of its first load; several tests look at the same ones."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assembly = load_structure(folder_of(name))
    return assembly, [str(warning.message) for warning in caught]


def pairs_of(assembly: Assembly) -> int:
    return len(np.unique(assembly.contacts.parts, axis=0))


@pytest.mark.parametrize("name", FOLDERS)
def test_exact_models_have_no_joints_to_resolve(name):
    assembly, _ = load(name)
    assert pairs_of(assembly) == FOLDERS[name]
    assert not len(assembly.report)


@pytest.mark.parametrize("name", INEXACT)
def test_inexact_models_load_with_one_line_about_their_joints(name):
    assembly, lines = load(name)
    pairs, deepest = INEXACT[name]
    assert pairs_of(assembly) == pairs
    assert sum("overlap up to" in line for line in lines) == 1
    report = assembly.report
    assert 0 < report.overlap.max() <= deepest
    assert report.gap.min() >= 0
    resolved = {tuple(pair) for pair in report.parts.tolist()}
    assert resolved <= {tuple(pair) for pair in assembly.contacts.parts.tolist()}


def test_open_parts_are_closed_with_one_line():
    assembly, lines = load("topolite-chips-256")
    assert (assembly.part_count, pairs_of(assembly)) == (256, 762)
    assert sum(line.endswith("repaired: closed flat holes") for line in lines) == 1
    _, lines = load("genevault-110")
    assert any(line.startswith("supports modelled as open surfaces (35, the first is part 0)") for line in lines)


def test_joints_of_the_armadillo_are_those_that_its_file_stores():
    """Areas of 1,014 interfaces by compas_cra, which leaves out those between supports."""
    graph = json.loads((folder_of("formats") / "armadillo_cra.json").read_text())["data"]["graph"]["data"]
    number = {node: part for part, node in enumerate(graph["node"])}
    stored = {}
    for one, others in graph["edge"].items():
        for other, edge in others.items():
            for interface in edge["interfaces"]:
                a, b = sorted((number[one], number[other]))
                stored[a, b] = stored.get((a, b), 0.0) + interface["data"]["size"]
    assert len(stored) == 1014
    assembly, _ = load("armadillo-399-cra")
    found = dict.fromkeys(stored, 0.0)
    for (a, b), area in zip(assembly.contacts.parts.tolist(), assembly.contacts.areas.tolist(), strict=True):
        if not assembly.boundary[[a, b]].all():
            found[a, b] = found.get((a, b), 0.0) + area
    ratio = np.array([found[pair] / stored[pair] for pair in stored])
    assert (ratio > 0.9).all()
    assert np.mean(np.abs(ratio - 1) <= 0.05) >= 0.95
    mean = np.mean(list(stored.values()))
    assert all(area <= 0.01 * mean for pair, area in found.items() if pair not in stored)


@pytest.mark.parametrize("name", ["armadillo-399", "armadillo-399-cra"])
def test_the_complete_armadillo_stands(name):
    """At the friction of compas_cra, whose file stores forces that balance the weight."""
    assembly = load(name)[0].replace(friction=0.84)
    state = complete_state(assembly.boundary)[None]
    for criterion in ("equilibrium", "contact"):
        assert (
            StabilityOracle(assembly, StabilitySettings(criterion=criterion))
            .verdicts(state, require_certificate=True)
            .stable.all()
        )
