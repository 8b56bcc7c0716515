"""Colours of unobserved surfaces."""

import numpy as np

from real2sim_server.reconstruct.initialise.surfels import (
    body_color,
    fill_from_neighbours,
    modal_colour,
)

WHITE, RED, DARK = np.float32([0.9, 0.9, 0.88]), np.float32([0.8, 0.1, 0.1]), np.float32([0.1] * 3)
EDGES = (-0.35, 0.0, 0.3)


def noisy(colour, count, seed=0):
    rng = np.random.default_rng(seed)
    return (colour + rng.normal(0, 0.02, (count, 3))).astype(np.float32)


def test_modal_colour_is_the_most_common_colour():
    colours = np.concatenate([noisy(WHITE, 300), noisy(RED, 200, 1)])
    assert np.abs(modal_colour(colours) - WHITE).max() < 0.02


def test_lamps_do_not_affect_the_body_colour():
    colours = np.concatenate([noisy(WHITE, 100), noisy(RED, 60, 1), np.zeros((50, 3), np.float32)])
    known = np.arange(len(colours)) < 160
    heights = np.full(len(colours), 0.1, np.float32)
    paint = body_color(heights, colours, known, np.tile(DARK, (len(colours), 1)), EDGES)
    assert np.abs(paint[~known] - WHITE).max() < 0.03


def test_height_bands_have_separate_colours():
    colours = np.concatenate([noisy(DARK, 100), noisy(WHITE, 200, 1)])
    heights = np.repeat(np.float32([-0.45, 0.1]), [100, 200])
    known = np.ones(300, bool)
    paint = body_color(heights, colours, known, np.tile(RED, (300, 1)), EDGES)
    assert np.abs(paint[0] - DARK).max() < 0.03
    assert np.abs(paint[-1] - WHITE).max() < 0.03


def test_an_object_with_few_samples_keeps_the_prior():
    colours, prior = noisy(WHITE, 10), np.tile(RED, (10, 1))
    known = np.arange(10) < 5
    assert (body_color(np.zeros(10, np.float32), colours, known, prior, EDGES) == prior).all()


def test_a_shorter_trust_reach_favours_the_prior():
    points = np.float32([[0, 0, 0], [0.5, 0, 0]])
    colours = np.stack([RED, np.zeros(3, np.float32)])
    known, prior = np.array([True, False]), np.stack([WHITE, WHITE])
    near = fill_from_neighbours(points, colours, known, prior, trust_reach=0.1)
    far = fill_from_neighbours(points, colours, known, prior, trust_reach=5.0)
    assert np.abs(near[1] - WHITE).max() < 0.02
    assert np.abs(far[1] - RED).max() < 0.1
