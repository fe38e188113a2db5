import numpy as np
import pytest

from imfvla import tasks
from imfvla.episode import ActionError
from imfvla.errors import UserError
from imfvla.tasks.experts import make_expert
from imfvla.tasks.experts.either_arm import EitherArmExpert
from imfvla.tasks.experts.transfer import TransferExpert
from imfvla.tasks.robot import JOINT_LIMITS


def play(env, expert, seed: int) -> tuple[list[int], np.ndarray, list]:
    """Stages after each step, states before each step and decisions of one episode."""
    env.reset(seed)
    expert.reset(env, seed)
    stages, states, decisions = [], [], []
    for step in range(env.time_limit_steps):
        states.append(env.state())
        decisions.append(expert.act(env, states[-1], step))
        stages.append(int(env.step(decisions[-1].executed).reward))
        if expert.done(env):
            break
    return stages, np.array(states), decisions


@pytest.mark.parametrize("modes", [1, 2, 4])
def test_demonstrations_succeed_stage_by_stage(env, modes):
    expert = make_expert(env.name, modes=modes, noise=0.004, hold=18, dwell=0)
    for seed in (11, 12):
        stages, states, decisions = play(env, expert, seed)
        assert max(stages) == len(env.stages)
        assert stages[-1] == len(env.stages)
        assert len(stages) < 400
        first = [
            next(i for i, s in enumerate(stages) if s >= stage) for stage in range(1, len(env.stages) + 1)
        ]
        assert first == sorted(first)
        passed_at_once = {"transfer": {3}, "either_arm": {1}}.get(env.goal or env.name, set())
        assert set(stages) >= set(range(1, len(env.stages) + 1)) - passed_at_once
        assert 10 <= stages.count(len(env.stages)) <= 40
        assert all(d.action.dtype == d.executed.dtype == np.float32 for d in decisions)
        margin = np.array(JOINT_LIMITS)[6] - [states[:, [6, 14]].min(), states[:, [6, 14]].max()]
        assert margin[0] < -0.3
        assert margin[1] > 0.3


@pytest.mark.parametrize("variant", ["easy", "hard"])
@pytest.mark.parametrize("name", tasks.NAMES)
def test_other_variants_can_be_solved(name, variant):
    env = tasks.load(name, variant=variant)
    stages, _, _ = play(env, make_expert(name, modes=2, noise=0.004, hold=18, dwell=0), 3)
    assert max(stages) == len(env.stages)
    env.close()


def test_the_hidden_mode_is_in_the_style_and_in_nothing_one_could_see(env):
    one, two = (make_expert(env.name, modes=modes, noise=0.0, hold=18, dwell=0) for modes in (1, 2))
    signs = []
    for seed in range(12):
        env.reset(seed)
        starts = []
        for expert in (one, two):
            env.reset(seed)
            expert.reset(env, seed)
            starts.append((env.start_digest(), env.state().tolist(), env.look()["top"].tobytes()))
        assert starts[0] == starts[1]
        assert one.style["turn_right"] == one.style["turn_left"] == two.style["turn_left"] == 1
        assert {k: v for k, v in one.style.items() if k != "turn_right"} == {
            k: v for k, v in two.style.items() if k != "turn_right"
        }
        signs.append(two.style["turn_right"])
    assert set(signs) == {-1.0, 1.0}


def test_both_ways_of_the_hidden_choice_part_at_once_and_their_mean_is_neither(env):
    """From the same start the right wrist turns a quarter either way."""
    one, two = (make_expert(env.name, modes=modes, noise=0.0, hold=18, dwell=0) for modes in (1, 2))
    seed = 0
    while True:
        env.reset(seed)
        two.reset(env, seed)
        if two.style["turn_right"] < 0:
            break
        seed += 1
    rolls = [play(env, expert, seed)[1][:, 14] for expert in (one, two)]
    assert abs(rolls[0][16] - rolls[1][16]) > 0.8
    ends = [roll[-1] for roll in rolls]
    assert abs(ends[0] - ends[1]) == pytest.approx(np.pi, abs=0.2)
    assert abs(np.mean(ends)) < 0.5


def test_four_modes_draw_both_arms(socket_env):
    expert = make_expert("socket", modes=4, noise=0.0, hold=18, dwell=0)
    seen = set()
    for seed in range(24):
        socket_env.reset(seed)
        expert.reset(socket_env, seed)
        seen.add((expert.style["turn_left"], expert.style["turn_right"]))
    assert len(seen) == 4


def test_noise_is_executed_and_not_recorded(env):
    expert = make_expert(env.name, modes=2, noise=0.01, hold=18, dwell=0)
    env.reset(0)
    expert.reset(env, 0)
    differences = []
    for step in range(60):
        decision = expert.act(env, env.state(), step)
        differences.append(decision.executed - decision.action)
        env.step(decision.executed)
    spread = np.std(differences, axis=0)
    joints = np.arange(16) % 8 != 7
    assert (spread[joints] > 5e-4).all()  # an arm that keeps still bears a fifth
    assert np.abs(differences).max() < 0.06
    assert (spread[~joints] == 0).all()


def test_a_push_is_corrected(env):
    """Thrown off during the approach, the expert still succeeds: what it does follows from what it measures."""
    expert = make_expert(env.name, modes=2, noise=0.0, hold=18, dwell=0)
    env.reset(2)
    expert.reset(env, 2)
    for step in range(env.time_limit_steps):
        decision = expert.act(env, env.state(), step)
        push = np.where(np.arange(16) % 8 == 0, 0.15, 0.0) if 40 <= step < 60 else 0.0
        env.step(decision.executed + push)
        if expert.done(env):
            break
    assert env.stage() == len(env.stages)


def test_a_hand_that_dwells_closes_later_by_what_was_drawn_and_does_all_else_as_before(transfer_env):
    at_once, dwelling = (
        make_expert("transfer", modes=1, noise=0.0, hold=18, dwell=dwell) for dwell in (0, 26)
    )
    (plain, _, before), (stages, _, after) = (play(transfer_env, expert, 3) for expert in (at_once, dwelling))
    wait = dwelling.style.pop("wait")
    assert at_once.style == dwelling.style
    assert wait > 5
    left = transfer_env.robot.action.index("left/gripper [0, 1]")
    closes = [
        next(i for i, d in enumerate(decisions) if d.action[left] < 0.5) for decisions in (before, after)
    ]
    assert closes[1] - closes[0] == wait
    assert all(np.array_equal(before[i].action, after[i].action) for i in range(closes[0]))
    assert max(plain) == max(stages) == len(transfer_env.stages)


@pytest.mark.parametrize("made", [TransferExpert, EitherArmExpert])
def test_the_time_that_a_hand_dwells_is_geometric(made):
    """It has no memory: having waited says nothing about how much longer it will take."""
    expert = made(modes=1, noise=0.0, hold=18, dwell=26)
    waits = np.array([expert.draw_style(np.random.default_rng(seed))["wait"] for seed in range(4000)])
    assert waits.min() == 1
    for steps in (8, 16, 48):
        assert (waits > steps).mean() == pytest.approx((1 - 1 / 26) ** steps, abs=0.025)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"name": "knitting", "modes": 2, "noise": 0.0, "hold": 18, "dwell": 0},
            "there is no task 'knitting'",
        ),
        (
            {"name": "socket", "modes": 3, "noise": 0.0, "hold": 18, "dwell": 0},
            "task.expert.modes must be 1, 2 or 4, found 3",
        ),
        ({"name": "socket", "modes": 2, "noise": 1.0, "hold": 18, "dwell": 0}, "task.expert.noise"),
        (
            {"name": "socket", "modes": 2, "noise": 0.0, "hold": 18, "dwell": 26},
            "task.expert.dwell must be 0: only those of transfer and either_arm wait, found 26",
        ),
        ({"name": "transfer", "modes": 2, "noise": 0.0, "hold": 18, "dwell": -1}, "task.expert.dwell"),
    ],
)
def test_mistakes_are_named(arguments, message):
    with pytest.raises(UserError, match=message):
        make_expert(**arguments)


def test_an_expert_refuses_another_task(transfer_env):
    with pytest.raises(UserError, match="expert of 'socket' was given the task 'transfer'"):
        make_expert("socket", modes=1, noise=0.0, hold=18, dwell=0).reset(transfer_env, 0)


def test_a_demonstration_fails_where_a_joint_target_jumps(socket_env):
    """Of the first 700 seeds of the socket task 129 alone passes a singularity of the wrist."""
    style = {"modes": 2, "noise": 0.004, "hold": 60, "dwell": 0}
    usual, smooth = make_expert("socket", **style), make_expert("socket", max_turn=0.1, **style)
    _, _, decisions = play(socket_env, usual, 129)
    joints = np.array([np.concatenate([d.action[:7], d.action[8:15]]) for d in decisions])
    turns = np.abs(np.diff(joints, axis=0)).max(axis=1)
    first = int(np.argmax(turns > 0.1)) + 1
    assert turns.max() > 0.1
    socket_env.reset(129)
    smooth.reset(socket_env, 129)
    for step in range(first):
        decision = smooth.act(socket_env, socket_env.state(), step)
        assert np.array_equal(decision.action, decisions[step].action)
        socket_env.step(decision.executed)
    with pytest.raises(ActionError, match=rf"a joint's target jumps by {turns[first - 1]:.2f} rad"):
        smooth.act(socket_env, socket_env.state(), first)


@pytest.mark.parametrize("turn", [0, -0.1])
def test_a_largest_turn_is_above_0(turn):
    with pytest.raises(
        UserError, match=r"task\.expert\.max_turn is a joint angle \[rad\] above 0, or null for any"
    ):
        make_expert("socket", modes=2, noise=0.004, hold=60, dwell=0, max_turn=turn)
