"""Random changes of settings: inside the extremes under which plans are tried, and never the same as one of these."""

from __future__ import annotations

import numpy as np
from changes import random_changes

from falsework.stability.contact.history import ReplaySettings
from falsework.stability.contact.varied_replay import MANY, variations


def test_random_changes_lie_between_the_extremes() -> None:
    extremes, drawn = variations(MANY), random_changes(200, np.random.default_rng(0))
    for value in (
        lambda change: change.ratio,
        lambda change: change.hold_factor,
        lambda change: change.replay.first_step,
        lambda change: change.replay.increments,
    ):
        least, most = (end(map(value, extremes)) for end in (min, max))
        found = [value(change) for change in drawn]
        assert least <= min(found) < max(found) <= most
        assert len(set(found)) > 10
    assert {change.press for change in drawn} == {change.press for change in extremes}


def test_new_contacts_have_friction_in_a_thicker_medium_alone() -> None:
    for change in (*variations(MANY), *random_changes(50, np.random.default_rng(1))):
        assert (change.replay.friction_noise > 0) == (change.replay.first_step < ReplaySettings.first_step)
