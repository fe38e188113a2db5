"""Scripted demonstrators: they read the simulator, and their recorded actions are what policies learn."""

from imfvla.errors import UserError
from imfvla.tasks.experts.base import Expert
from imfvla.tasks.experts.combined import CombinedExpert
from imfvla.tasks.experts.either_arm import EitherArmExpert
from imfvla.tasks.experts.gate import GateExpert
from imfvla.tasks.experts.socket import SocketExpert
from imfvla.tasks.experts.transfer import TransferExpert

_EXPERTS = {
    "socket": SocketExpert,
    "transfer": TransferExpert,
    "combined": CombinedExpert,
    "either_arm": EitherArmExpert,
    "gate": GateExpert,
}


def make_expert(name: str, *, modes: int, noise: float, hold: int, dwell: int) -> Expert:
    """The expert of the task `name`; see `Expert` for the rest. UserError on an unknown name."""
    if name not in _EXPERTS:
        raise UserError(
            f"There is no expert for a task {name!r}; choose one of {', '.join(sorted(_EXPERTS))}."
        )
    return _EXPERTS[name](modes=modes, noise=noise, hold=hold, dwell=dwell)
