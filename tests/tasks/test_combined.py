import numpy as np
import pytest

from imfvla import tasks
from imfvla.tasks.combined import GOALS
from imfvla.tasks.experts import make_expert
from imfvla.tasks.props import BAR_WIDTH


def poses(env):
    return {name: env.task.prop_pose(env.physics, name) for name in env.task.props}


@pytest.mark.parametrize("variant", tasks.VARIANTS)
def test_both_sentences_are_said_of_every_start(variant):
    env = tasks.load("combined", variant=variant)
    starts = {}
    for seed in range(8):
        env.reset(seed)
        starts.setdefault(env.start_digest(), []).append((env.goal, env.instruction, len(env.stages)))
    said = [(goal, tasks.text_for(goal)[0], stages) for goal, stages in zip(GOALS, (5, 4), strict=True)]
    assert list(starts.values()) == [said] * 4
    env.close()


@pytest.mark.parametrize("variant", tasks.VARIANTS)
def test_a_gripper_fits_between_peg_and_bar_and_either_is_in_front(variant):
    env = tasks.load("combined", variant=variant)
    in_front = set()
    for seed in range(0, 80, 2):
        env.reset(seed)
        assert env.stage() == 0
        found = poses(env)
        near = {}
        for name, half in (("peg", 0.085), ("bar", 0.11)):
            pose = found[name]
            reach = half * abs(pose.rotation[1, 0]) + BAR_WIDTH / 2
            near[name] = (pose.position[1] - reach, pose.position[1] + reach)
        first, second = sorted(near, key=lambda name: near[name])
        in_front.add(first)
        assert near[second][0] - near[first][1] > 0.03
    assert in_front == {"peg", "bar"}
    env.close()


def test_the_expert_does_what_the_sentence_says_and_leaves_the_rest():
    env = tasks.load("combined", variant="easy")
    for seed, moved in ((4, {"socket", "peg"}), (5, {"bar"})):
        env.reset(seed)
        expert = make_expert("combined", modes=1, noise=0.0, hold=18, dwell=0)
        expert.reset(env, seed)
        before = poses(env)
        for step in range(env.time_limit_steps):
            env.step(expert.act(env, env.state(), step).executed)
            if expert.done(env):
                break
        assert env.stage() == len(env.stages)
        after = poses(env)
        found = {n for n in before if np.linalg.norm(after[n].position - before[n].position) > 0.01}
        assert found == moved
    env.close()
