"""The instructions of each task: one canonical sentence and its paraphrases."""

from imfvla.errors import UserError

TEXTS: dict[str, tuple[str, tuple[str, ...]]] = {
    "socket": (
        "insert the peg into the socket",
        (
            "put the peg into the socket",
            "push the orange peg through the blue socket",
            "pick up peg and socket and plug them together",
            "plug the peg into the ring",
            "join the peg and the socket in the air",
        ),
    ),
    "transfer": (
        "hand the bar over to the left arm",
        (
            "pass the bar from the right gripper to the left gripper",
            "give the bar to the left arm",
            "transfer the bar to the other hand",
            "pick up the bar with the right arm and hand it to the left",
            "let the left gripper take over the bar",
        ),
    ),
    "either_arm": (
        "lift the bar with both arms and let either one keep it",
        (
            "raise the bar together and leave it to one arm",
            "pick up the bar with both grippers and hand it over to either of them",
            "lift the bar with both hands and let one of them go",
            "one arm gives the bar and the other one takes it",
        ),
    ),
    "gate": (
        "carry the bar past the post without touching it",
        (
            "bring the bar behind the post and do not touch the post",
            "carry the orange bar around or over the post",
            "pass the post with the bar in the right gripper",
            "take the bar to the other side of the post",
        ),
    ),
}


def text_for(name: str) -> tuple[str, tuple[str, ...]]:
    """The canonical instruction of the task `name` and its paraphrases. UserError on an unknown name."""
    if name not in TEXTS:
        raise UserError(f"There is no task {name!r}; choose one of {', '.join(sorted(TEXTS))}.")
    return TEXTS[name]
