"""Several episodes of one policy side by side in one process, which computes the chunks of a step in one batch.

A chunk alone is mostly the cost of calling operators on few numbers; eight at once take about twice the time of one.
"""

from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass

from imfvla.environment import Environment
from imfvla.environments.rollout import Running
from imfvla.episode import EpisodeResult
from imfvla.rollouts.actor import ChunkActor


@dataclass(frozen=True, slots=True)
class Player:
    """An episode in its place of a batch."""

    place: int
    env: Environment
    actor: ChunkActor
    running: Running  # of `environments.rollout.episode` with this environment and this actor


def play_in_lockstep(players: Sequence[Player], size: int) -> list[EpisodeResult]:
    """Plays episodes that begin together, in batches of always `size` rows; returns their rows in their order.

    Actors are of one policy and one kind, so that their clocks agree. An episode that has ended leaves its place empty.
    What an episode does depends on its place and on `size`, and not on the others.
    """
    results: dict[int, EpisodeResult] = {}
    with ExitStack() as closes:
        for player in players:
            closes.enter_context(closing(player.running))
        while left := [player for player in players if player.place not in results]:
            questions = [None] * size
            for player in left:
                try:
                    state, step = next(player.running)
                except StopIteration as end:
                    results[player.place] = end.value
                else:
                    questions[player.place] = player.actor.look(player.env, state, step)
            if any(question is not None for question in questions):
                samples, inference_ms = left[0].actor.ask(questions)
                for player in left:
                    if questions[player.place] is not None:
                        player.actor.take(samples[player.place], inference_ms)
    return [results[player.place] for player in players]
