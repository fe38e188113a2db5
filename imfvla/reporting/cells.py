"""A metric as the cell of a table: ours with its interval, ours alone, and as the paper prints it."""

from collections.abc import Mapping
from typing import Any

from imfvla.reporting.metrics import METRICS, Metric
from imfvla.reporting.paper import PaperRow
from imfvla.reporting.results import Result
from imfvla.reporting.table import MISSING, NOTHING, interval, number, with_interval

SHOWN = tuple(metric for metric in METRICS if metric.title is not None)  # in tables for people
TITLES = tuple(metric.title for metric in SHOWN)
BY_NAME = {metric.name: metric for metric in METRICS}


def with_its_interval(metric: Metric, result: Result) -> str:
    """Of a row of ours, a count as in "84/100 [75.6%, 89.9%]"."""
    if result.is_missing:
        return MISSING
    measured = result.metrics[metric.name]
    if metric.share is not None and measured.value is not None:
        share = result.metrics[metric.share].scaled(100)
        return f"{measured.value}/{len(result.episodes)} {interval(share, 1, '%')}"
    if metric.estimate is None:
        return number(measured.value, metric.digits)
    return with_interval(measured, metric.digits)


def alone(metric: Metric, summary: Mapping[str, Any]) -> str:
    """Of a summary with the numbers of its episodes."""
    value = summary.get(metric.name)
    is_count = metric.share is not None and value is not None
    return f"{value}/{summary['episodes']}" if is_count else number(value, metric.digits)


def printed(metric: Metric, paper: PaperRow) -> str:
    """Of a row of the paper; a dash for what it does not print."""
    if metric.printed is None:
        return NOTHING
    value = getattr(paper, metric.printed)
    return number(value, metric.printed_digits) if metric.share is None else f"{value}/{paper.episodes}"
