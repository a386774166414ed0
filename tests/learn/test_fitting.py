"""A law comes back from traits and answers."""

import numpy as np

from kibs_steps.learn import fitting
from kibs_steps.models import perceptron


def test_a_known_law_comes_back():
    """One that no straight line tells: likely where two traits have the same sign; a third says nothing."""
    rng = np.random.default_rng(0)
    traits = rng.normal([100, 0, 5], [10, 0.1, 1], (20000, 3))
    chance = 1 / (1 + np.exp(-2 * (traits[:, 0] - 100) * traits[:, 1]))
    answers = rng.random(len(traits)) < chance
    terms = fitting.fitted(traits, answers, np.ones(len(traits)), steps=800)
    assert perceptron.leads(terms, 3)
    assert np.abs(perceptron.likely(traits, terms) - chance).mean() < 0.05
    assert fitting.fitted(traits, answers, np.ones(len(traits)), steps=800) == terms


def test_what_weighs_nothing_teaches_nothing():
    traits = np.repeat([[0.0], [1.0]], 500, axis=0)
    answers = np.ones(1000, bool)
    answers[500:] = np.arange(500) % 2 == 0
    weight = np.where(answers, 1.0, 0.0)
    terms = fitting.fitted(traits, answers, weight, steps=200)
    assert (perceptron.likely(traits, terms) > 0.9).all()
