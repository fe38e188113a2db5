"""What samples are, with several NFE beside the demonstrations: numbers, curves and a table.

Shapes: N observations, K samples of each, Tp predicted steps, A action.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from imfvla.modes import grippers, turns
from imfvla.modes.observations import Observations, Stops
from imfvla.modes.samples import draw_samples
from imfvla.modes.spread import joints_of, measure_jumps, measure_spread
from imfvla.policy import Policy
from imfvla.reporting.table import Table, number

DEMONSTRATIONS = "demonstrations"
# Column, key of a row, digits, factor; a column that no row has a number for is left out.
COLUMNS = (
    ("closes [%]", "closes", 1, 100),
    ("in order [%]", "in_order", 1, 100),
    ("lets go [%]", "lets_go", 1, 100),
    ("between [%]", "between", 1, 100),
    ("bridge [%]", "bridge", 1, 100),
    ("arrived [%]", "arrived", 1, 100),
    ("roll [rad]", "amplitude", 2, 1),
    ("spread", "spread", 2, 1),
    ("spread / error", "spread_ratio", 2, 1),
    ("jump [rad]", "jump_rad", 3, 1),
    ("jump", "jump", 2, 1),
)
GRIPPER_NOTE = (
    "Grippers, at {num} observations before one closes: samples that close within the {executed} executed steps; of "
    "those that close, how many let the other hand go 3 to 6 steps later; that let it go before, without or too soon "
    "after closing; whose gripper is neither open nor closed for more than 3 steps."
)
TURN_NOTE = (
    f"Wrists that may roll either way, at {{num}} starts, after {turns.STEPS} steps: samples within "
    f"{turns.BRIDGE:g} rad of the middle of both ways, beyond {turns.ARRIVED:g} rad, mean roll."
)
SPREAD_NOTE = (
    "Spread, at {num} decisions: standard deviation of samples over their noise at one observation, in units of the "
    "actions' deviation at each step; and as a share of the demonstrations' deviation from the samples' mean, 1 for "
    "samples distributed as the demonstrations are. Jump: by how much a chunk and the next one disagree over the steps "
    "they share, root mean square over the joints, and over all channels in the same units."
)


def measure(
    policy: Policy, stops: Stops, nfes: Sequence[int], num: int, modes: int, advance: Callable[[], None]
) -> dict[str, Any]:
    """Rows by "demonstrations" and NFE, `num` samples at each place.

    `advance` is called after each number. Raises UserError where the generator does not take one of them.
    """
    assert num >= 2, "one sample alone has no spread"
    for nfe in nfes:
        policy.generator.check_nfe(nfe)
    wrists = turns.drawn_wrists(modes, policy.robot) if policy.horizon.pred >= turns.STEPS else ()
    scale = policy.chunks.normaliser.scale.cpu().numpy()
    rows = {}
    for nfe in (None, *nfes):

        def chunks(places: Observations, nfe: int | None = nfe) -> np.ndarray:
            if nfe is None:
                return np.stack(places.actions)[:, None]
            return draw_samples(policy, places, nfe, num)

        row = rows[DEMONSTRATIONS if nfe is None else str(nfe)] = {}
        if stops.events:
            found = grippers.closings(chunks(stops.waiting), stops.events)
            row |= grippers.measure_closings(found, policy.horizon.exec)
            row |= {"fates": grippers.fates(found), "closed_by": grippers.closed_by(found).tolist()}
        if wrists:
            state = np.stack(stops.starts.state)[:, -1]
            rolls = turns.turns(chunks(stops.starts), state, wrists)
            row |= turns.measure_turns(rolls) | {"rolls": rolls.ravel().tolist()}
        if nfe is not None and len(stops.before):
            before, after = chunks(stops.before), chunks(stops.after)
            row |= measure_spread(before, np.stack(stops.before.actions), scale)
            row |= measure_jumps(before, after, stops.gap, scale, joints_of(policy.robot))
        if nfe is not None:
            advance()
    places = {"waiting": len(stops.waiting), "starts": len(stops.starts), "decisions": len(stops.before)}
    return {
        "samples": num,
        "executed": policy.horizon.exec,
        "bridge_rad": turns.BRIDGE,
        "arrived_rad": turns.ARRIVED,
        "observations": places,
        "rows": rows,
    }


def modes_table(measured: Mapping[str, Any], title: str) -> Table:
    """A row for the demonstrations and for each NFE."""
    rows, num = measured["rows"], measured["observations"]
    shown = [column for column in COLUMNS if any(row.get(column[1]) is not None for row in rows.values())]
    cells = tuple(
        (name, *(_cell(row.get(key), digits, factor) for _, key, digits, factor in shown))
        for name, row in rows.items()
    )
    keys = {key for _, key, _, _ in shown}
    notes = (
        ("closes", GRIPPER_NOTE.format(num=num["waiting"], executed=measured["executed"])),
        ("bridge", TURN_NOTE.format(num=num["starts"])),
        ("spread", SPREAD_NOTE.format(num=num["decisions"])),
    )
    return Table(
        title,
        ("NFE", *(name for name, *_ in shown)),
        cells,
        tuple(text for key, text in notes if key in keys),
    )


def _cell(value: float | None, digits: int, factor: float) -> str:
    return number(None if value is None else factor * value, digits)
