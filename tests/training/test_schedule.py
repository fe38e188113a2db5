import pytest

from imfvla.training.schedule import learning_rate

OPTIONS = {"steps": 101, "peak": 2.0, "warmup": 0.1, "floor": 0.25}


def test_closed_form():
    rising = [learning_rate(step, **OPTIONS) for step in range(10)]
    assert rising == pytest.approx([0.2 * (step + 1) for step in range(10)])
    assert learning_rate(10, **OPTIONS) == 2.0
    assert learning_rate(55, **OPTIONS) == pytest.approx(2.0 * (0.25 + 0.75 / 2))  # half-way down
    assert learning_rate(100, **OPTIONS) == pytest.approx(0.5)


def test_falls_after_the_warm_up():
    falling = [learning_rate(step, **OPTIONS) for step in range(10, 101)]
    assert falling == sorted(falling, reverse=True)


@pytest.mark.parametrize("steps", [1, 2, 3])
@pytest.mark.parametrize("warmup", [0.0, 0.5, 1.0])
def test_tiny_runs_have_a_rate(steps, warmup):
    for step in range(steps):
        assert 0 < learning_rate(step, steps=steps, peak=1.0, warmup=warmup, floor=0.1) <= 1
