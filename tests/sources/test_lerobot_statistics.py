"""Statistics of a LeRobot data set against numpy over all values at once."""

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="needs the extra lerobot")

from imfvla.sources.lerobot.statistics import KEYS, QUANTILES, Pool, of_pictures, of_samples


def test_pooled_extremes_means_and_deviations_are_those_of_all_values():
    rng = np.random.default_rng(0)
    parts = [rng.normal(number, 1 + number, (5 + 7 * number, 3)) for number in range(4)]
    pool = Pool()
    for part in parts:
        pool.add(of_samples(part))
    found, values = pool.result(), np.concatenate(parts)
    assert tuple(found) == KEYS
    assert found["count"] == len(values)
    for key, expected in (
        ("min", values.min(0)),
        ("max", values.max(0)),
        ("mean", values.mean(0)),
        ("std", values.std(0)),
    ):
        assert np.allclose(found[key], expected)
    # As LeRobot pools them: the mean of the episodes' quantiles, weighted by their counts.
    for key, share in QUANTILES.items():
        expected = sum(len(part) * np.quantile(part, share, axis=0) for part in parts) / len(values)
        assert np.allclose(found[key], expected)


@pytest.mark.parametrize(("shape", "count"), [((3, 8, 8), 3), ((150, 4, 4), 100), ((2, 600, 4), 2)])
def test_pictures_are_thinned_and_scaled_to_1(shape, count):
    frames = np.zeros((*shape, 3), np.uint8)
    frames[..., 1] = 255
    found = of_pictures(frames)
    assert found["count"] == count
    assert found["mean"].shape == (3, 1, 1)
    assert found["max"].ravel().tolist() == found["q50"].ravel().tolist() == [0, 1, 0]
