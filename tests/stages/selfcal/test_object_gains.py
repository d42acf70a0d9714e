"""Gains from the object, and how far they are believed."""

from dataclasses import replace

import numpy as np

from polcap.stage_values import Equipment
from polcap.stages.selfcal.object_gains import GainEstimate, with_prior
from tests import scenes
from tests.stages.selfcal.shapes import solve

GAIN = np.array([1.0, 1.013, 0.981])


def test_without_a_chart_the_gains_come_from_the_object():
    found = solve(scenes.stack(gain=GAIN, noise=0.004)).gains
    assert found.source == "object"
    assert np.abs(found.gain.mean(1) / GAIN - 1).max() < 0.005


def test_one_exposure_has_one_gain():
    found = solve(replace(scenes.stack(gain=GAIN), equipment=Equipment("one exposure"))).gains
    assert found.source == "one exposure"
    assert (found.gain == 1).all() and (found.sigma == 0).all()


def test_far_gains_are_applied_only_where_their_error_is_small():
    far = with_prior(GainEstimate(np.array([1.0, 0.6, 1.3]), np.array([0.0, 0.2, 0.1])), 0.03)
    assert np.abs(far.gain - 1).max() <= 0.03
    wild = with_prior(GainEstimate(np.array([1.0, 0.6, 1.3]), np.array([0.0, 0.1, 0.08])), 0.03)
    assert (wild.gain == 1).all() and wild.sigma[1] >= 0.4
    misfire = with_prior(GainEstimate(np.array([1.0, 0.7, 1.0]), np.array([0.0, 0.005, 0.005])), 0.03)
    assert misfire.gain[1] == 0.7
