"""The noise of chunks: a function of the place alone, whatever is drawn with it."""

import numpy as np

from imfvla.policy.noise import chunk_noise


def test_each_chunk_s_noise_is_that_of_its_place():
    drawn = chunk_noise((4, 3), [(0, 7), np.array([5, 7, 1])]).numpy()
    for found, place in zip(drawn, ([0, 7], [5, 7, 1]), strict=True):
        wanted = np.random.default_rng(np.random.SeedSequence(place)).standard_normal((4, 3), np.float32)
        np.testing.assert_array_equal(found, wanted)
