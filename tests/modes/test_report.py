"""The report on a policy whose samples are known, and the figure of it."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import nn

from imfvla.config.horizon import Horizon
from imfvla.errors import UserError
from imfvla.figures.modes import modes_figure
from imfvla.modes.grippers import grippers_of
from imfvla.modes.observations import Stops
from imfvla.modes.report import DEMONSTRATIONS, measure, modes_table
from imfvla.tasks.bimanual_robot import bimanual_robot
from imfvla.types import Observation

HORIZON = Horizon(1, 32, 16)
CLOSES, NUM_STEPS, WAIT = 60, 120, 20
WRIST = 14
ROBOT = bimanual_robot(("front",), (8, 8))
GRIPPERS = LEFT, RIGHT = grippers_of(ROBOT)


class TwoWays(nn.Module):
    """Follows the demonstration, and rolls the wrist either way by the sign of its noise; one NFE ends between."""

    horizon, noise_shape, robot = HORIZON, (32, 16), ROBOT

    def __init__(self, actions: np.ndarray) -> None:
        super().__init__()
        self.actions = nn.Parameter(torch.from_numpy(actions), requires_grad=False)
        self.chunks = SimpleNamespace(normaliser=SimpleNamespace(scale=torch.ones(32, 16)))
        self.generator = SimpleNamespace(check_nfe=self._check)

    def _check(self, nfe: int) -> None:
        if nfe < 1:
            raise UserError("at least 1")

    def predict(self, obs: Observation, noise: torch.Tensor, nfe: int) -> torch.Tensor:
        steps = obs.state[:, -1, 0].round().long()
        steps = steps.repeat_interleave(len(noise) // len(steps))
        rows = (steps[:, None] + torch.arange(32)).clamp(max=NUM_STEPS - 1)
        chunk = self.actions[rows].clone()
        chunk[:, :, WRIST] = (0.1 if nfe == 1 else 0.9) * noise[:, :1, 0].sign()
        return chunk


@pytest.fixture
def actions() -> np.ndarray:
    actions = np.zeros((NUM_STEPS, 16), np.float32)
    actions[:, LEFT] = np.arange(NUM_STEPS) < CLOSES
    actions[:, RIGHT] = (np.arange(NUM_STEPS) < 10) | (np.arange(NUM_STEPS) >= CLOSES + 4)
    return actions


def stops_of(actions: np.ndarray, wait: int = WAIT) -> Stops:
    stops = Stops(HORIZON, ("front",), GRIPPERS, num_episodes=2, most=50)
    for seed in range(2):
        state = np.zeros((NUM_STEPS, 16), np.float32)
        state[:, 0] = np.arange(NUM_STEPS)
        done = actions.copy()
        done[:, WRIST] = (0.9, -0.9)[seed]
        steps = np.arange(0, NUM_STEPS, 2)
        info = SimpleNamespace(seed=seed, instruction="pass it", metadata={"style": {"wait": wait}})
        images = {"front": np.zeros((len(steps), 8, 8, 3), np.uint8)}
        stops.add(SimpleNamespace(info=info, action=done, state=state, image_steps=steps, images=images))
    stops.finish()
    return stops


def test_observations_are_those_at_which_a_policy_waits_begins_and_goes_on(actions):
    stops = stops_of(actions)
    assert {place.step for place in stops.waiting.places} == set(range(CLOSES - WAIT, CLOSES, 2))
    assert [tuple(place) for place in stops.starts.places] == [(0, 0), (1, 0)]
    assert [b.step + 16 for b in stops.before.places] == [a.step for a in stops.after.places]
    assert max(place.step for place in stops.after.places) <= NUM_STEPS - 32
    assert {place.step for place in stops_of(actions, wait=0).waiting.places} == set(
        range(CLOSES - 32, CLOSES, 2)
    )


def test_the_report_tells_a_policy_that_decides_from_one_that_does_not(actions):
    measured = measure(TwoWays(actions), stops_of(actions), [1, 2], 8, modes=2, advance=lambda: None)
    rows = measured["rows"]
    # 7 of the 10 steps with frames
    assert rows[DEMONSTRATIONS]["closes"] == rows["2"]["closes"] == pytest.approx(0.7)
    assert rows["2"]["in_order"] == 1.0
    assert (rows["1"]["bridge"], rows["2"]["bridge"]) == (1.0, 0.0)
    assert (rows["1"]["arrived"], rows["2"]["arrived"], rows[DEMONSTRATIONS]["arrived"]) == (0.0, 1.0, 1.0)
    assert rows["2"]["spread"] == pytest.approx(9 * rows["1"]["spread"])
    table = modes_table(measured, "samples")
    assert [row[0] for row in table.rows] == [DEMONSTRATIONS, "1", "2"]
    assert len(table.notes) == 3
    assert len(modes_figure(measured, "samples").axes) == 6


def test_without_known_modes_spread_and_jumps_are_left(actions):
    actions[:, [LEFT, RIGHT]] = 1.0
    measured = measure(TwoWays(actions), stops_of(actions), [2], 8, modes=1, advance=lambda: None)
    columns = modes_table(measured, "samples").columns
    assert columns == ("NFE", "spread", "spread / error", "jump [rad]", "jump")
    assert len(modes_figure(measured, "samples").axes) == 2


def test_numbers_that_the_generator_does_not_take_are_refused(actions):
    with pytest.raises(UserError, match="at least 1"):
        measure(TwoWays(actions), stops_of(actions), [2, 0], 8, modes=2, advance=lambda: None)
