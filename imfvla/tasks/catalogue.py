"""The tasks of this package, one entry each. Needs neither mujoco nor dm_control: classes are named, not imported."""

from dataclasses import dataclass
from importlib import import_module
from typing import Any

from imfvla.errors import UserError


@dataclass(frozen=True, slots=True)
class Entry:
    """A task: its class and its expert's, what is asked for, and the names of its stages in order.

    A scene that serves several tasks has none of the last three of its own: they are those of an episode's goal.
    """

    task: str  # module and class below imfvla.tasks
    expert: str
    instruction: str = ""
    paraphrases: tuple[str, ...] = ()
    stages: tuple[str, ...] = ()


TASKS = {
    "socket": Entry(
        task="socket.SocketTask",
        expert="experts.socket.SocketExpert",
        instruction="insert the peg into the socket",
        paraphrases=(
            "put the peg into the socket",
            "push the orange peg through the blue socket",
            "pick up peg and socket and plug them together",
            "plug the peg into the ring",
            "join the peg and the socket in the air",
        ),
        stages=("grasp both", "lift both", "at the mouth", "inside", "seated"),
    ),
    "transfer": Entry(
        task="transfer.TransferTask",
        expert="experts.transfer.TransferExpert",
        instruction="hand the bar over to the left arm",
        paraphrases=(
            "pass the bar from the right gripper to the left gripper",
            "give the bar to the left arm",
            "transfer the bar to the other hand",
            "pick up the bar with the right arm and hand it to the left",
            "let the left gripper take over the bar",
        ),
        stages=("grasp", "lift", "both hold", "handed over"),
    ),
    "either_arm": Entry(
        task="either_arm.EitherArmTask",
        expert="experts.either_arm.EitherArmExpert",
        instruction="lift the bar with both arms and let either one keep it",
        paraphrases=(
            "raise the bar together and leave it to one arm",
            "pick up the bar with both grippers and hand it over to either of them",
            "lift the bar with both hands and let one of them go",
            "one arm gives the bar and the other one takes it",
        ),
        stages=("grasp", "grasp both", "lift both", "one alone", "other away"),
    ),
    "gate": Entry(
        task="gate.GateTask",
        expert="experts.gate.GateExpert",
        instruction="carry the bar past the post without touching it",
        paraphrases=(
            "bring the bar behind the post and do not touch the post",
            "carry the orange bar around or over the post",
            "pass the post with the bar in the right gripper",
            "take the bar to the other side of the post",
        ),
        stages=("grasp", "lift", "at the post", "past the post"),
    ),
    "combined": Entry(task="combined.CombinedTask", expert="experts.combined.CombinedExpert"),
}
NAMES = tuple(TASKS)


def entry_of(name: str) -> Entry:
    """The entry of the task `name`. UserError on an unknown name."""
    if name not in TASKS:
        raise UserError(
            f"task.name must be one of {', '.join(sorted(TASKS))}: there is no task {name!r}; correct it."
        )
    return TASKS[name]


def text_for(name: str) -> tuple[str, tuple[str, ...]]:
    """The canonical instruction of the task `name` and its paraphrases. UserError on an unknown name."""
    entry = entry_of(name)
    return entry.instruction, entry.paraphrases


def class_at(place: str) -> Any:
    """The class that an entry names; its module imports dm_control."""
    module, _, name = place.rpartition(".")
    return getattr(import_module(f"imfvla.tasks.{module}"), name)
