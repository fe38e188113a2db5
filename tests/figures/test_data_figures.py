"""Figures of results: what they show of synthetic runs, that nothing is cut off, and what is drawn of no run at all."""

import json

import numpy as np
import pytest
from seen import clipped, texts
from synthetic_runs import answer_row, episodes_of, make_run, write_evaluation

from imfvla.errors import UserError
from imfvla.figures.ablations import ablations
from imfvla.figures.depth_attention import FILE, depth_attention, read_depth_attention
from imfvla.figures.evaluations import success_by_evaluations
from imfvla.figures.failures import failed_stages
from imfvla.figures.learning import learning_curves
from imfvla.figures.methods import success_by_cost
from imfvla.figures.panels import look, numbers, panels_of
from imfvla.figures.reward_latency import errors, pareto_frontier, reward_latency
from imfvla.reporting.answers import Sources
from imfvla.reporting.curves import learning_curve
from imfvla.reporting.mapping import read_mapping
from imfvla.reporting.results import Result
from imfvla.reporting.rows import first_failed_stage
from imfvla.reporting.statistics.measured import Measured

MAPPING = read_mapping()
MISSING = ("socket_smolvla", "transfer_dit_ph08_exec08", "socket_l1")
FIGURES = [reward_latency, ablations, success_by_evaluations, learning_curves, failed_stages, success_by_cost]


def results_of(*directories) -> list[Result]:
    sources = Sources(directories)
    return [Result.of(sources.answer(row, MAPPING)) for row in MAPPING.rows]


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> list[Result]:
    """Of all rows but three."""
    root = tmp_path_factory.mktemp("runs")
    for index, row in enumerate(MAPPING.rows):
        if row.name not in MISSING:
            quality = 0.25 + 0.6 * np.random.default_rng(index).random()
            answer_row(root, row, quality=quality, latency_ms=2.0 + 4.5 * row.nfe)
    return results_of(root)


def of_table(results, table: str) -> list[Result]:
    return [result for result in results if result.row.table == table]


@pytest.mark.parametrize("draw", FIGURES)
def test_no_text_is_cut_off_whether_there_are_results_or_none(draw, results, tmp_path):
    for found in (results, results_of(tmp_path)):
        table = {reward_latency: "table1", ablations: "table2", success_by_cost: "dwell"}.get(draw)
        assert not clipped(draw(of_table(found, table) if table else found))


def test_a_missing_row_is_marked_and_has_no_bar(results):
    figure = ablations(of_table(results, "table2"))
    assert texts(figure).count("missing") == 2  # in both panels
    lengths = [[bar.get_width() for bar in axes.containers[-1]] for axes in figure.axes]
    assert all(np.isnan(panel[8]) and np.isfinite(np.delete(panel, 8)).all() for panel in lengths)


def test_costs_are_shown_for_each_method_with_its_trainings(results):
    figure = success_by_cost(of_table(results, "dwell"))
    calls, times = (
        [np.array(bars[0].get_xdata(), float) for bars in axes.containers] for axes in figure.axes
    )
    for found in calls:
        assert list(np.round(found / found[0])) in ([1, 2, 10], [1])
    several = [np.round(found / found[0], 1).tolist() for found in times if len(found) == 3]
    assert several == 4 * [[1, 1.7, 7.2]]  # two forms of iMF, flow matching, DDIM


def test_a_method_has_the_number_of_its_generator_and_others_what_is_left(tmp_path):
    kinds = ("imf.ImprovedMeanFlow", "outside.Mine", "flow.FlowMatching", "flow.FlowMatching", "imle.Other")
    for place, kind in enumerate(kinds):
        run = make_run(
            tmp_path / f"{place}" / "default", f"e{place}", generator={"_target_": f"imfvla.{kind}"}
        )
        write_evaluation(run, 1, number=100)
    results = [Result(evaluated) for evaluated in Sources([tmp_path]).others([])]
    assert numbers(results) == [5, 0, 1, 2, 3]
    assert len({tuple(look(number).items()) for number in numbers(results * 4)}) == 20


def test_the_frontier_is_what_nothing_beats_in_both():
    points = [(2.6, 466), (14.4, 1473), (15.1, 1514), (16.2, 1275), (100, 290), (14.4, 1000)]
    assert pareto_frontier(points) == [(2.6, 466), (14.4, 1473), (15.1, 1514)]


def test_printed_values_and_ours_are_in_panels_of_their_own(results):
    paper, ours = reward_latency(of_table(results, "table1")).axes
    assert len(paper.texts) == 7
    assert len(ours.texts) == 15
    assert "3" in [text.get_text() for text in paper.texts]


def test_error_bars_reach_from_the_value_to_its_interval():
    found = errors([Measured(5.0, 4.0, 7.0), Measured(1.0)])
    np.testing.assert_array_equal(found, [[1, np.nan], [2, np.nan]])


def test_the_first_failed_stage_by_hand():
    row = episodes_of(0.5, 100_000, 1, task="socket", latency_ms=1.0)[0]
    assert first_failed_stage(row | {"first_step_of_stage": [3, 9, -1, -1]}) == 2
    assert first_failed_stage(row | {"first_step_of_stage": [3, 9, 11, 12]}) is None
    assert first_failed_stage(row | {"first_step_of_stage": [-1, -1]}) == 0


def test_a_bar_of_failures_ends_at_their_share(results):
    found, drawn = panels_of(results), [axes.get_title(loc="left") for axes in failed_stages(results).axes]
    assert "A hand-over whose moment is hidden" in drawn  # no rows among those of object transfer
    for axes, title in zip(failed_stages(results).axes, drawn, strict=True):
        ends = [bar.get_x() + bar.get_width() for bar in axes.containers[-1]]
        shares = [100 - 100 * result.metrics["success_share"].value for result in found[title]]
        np.testing.assert_allclose(sorted(ends), sorted(shares), atol=1e-9)


def test_rows_of_one_experiment_are_in_the_panels_of_their_tables(results, tmp_path):
    names = {title: {result.row.name for result in found} for title, found in panels_of(results).items()}
    assert "socket800_imf_infer1" in names["Socket peg insertion, 800 demonstrations"]
    assert {"socket_infer2", "socket_ddpm_ph16", "socket_act"} <= names["socket peg insertion"]
    outside = make_run(tmp_path / "socket_ph32_exec16" / "x", "socket_ph32_exec16")
    write_evaluation(outside, 1, number=100)
    (other,) = [Result(evaluated) for evaluated in Sources([tmp_path]).others([])]
    assert other in panels_of([other])["socket peg insertion"]


def test_results_of_a_method_are_grouped_under_its_name(results):
    socket = failed_stages(of_table(results, "table1")).axes[0]
    names = [label.get_text().replace("\N{FIGURE SPACE}", "") for label in socket.get_yticklabels()]
    first = names.index("Flow, high-noise times   NFE 1")
    assert [name.strip() for name in names[first + 1 : first + 3]] == ["NFE 2", "NFE 10"]
    assert "iMF-AttnRes, weights of step 200   NFE 1" in names  # of a third of the training
    assert not any("=" in name for name in names)


def test_weights_at_the_end_of_training_are_compared_over_nfe(results):
    panels = success_by_evaluations(of_table(results, "table1")).axes
    lines = {
        axes.get_title(loc="left"): [len(bars.lines[0].get_xdata()) for bars in axes.containers]
        for axes in panels
    }
    assert lines["iMF-AttnRes"] == [2]  # the row of one NFE uses a third of the training
    assert lines["Diffusion-style VLA, ph32, exec16"] == [4]
    assert lines["Flow, high-noise times"] == [3]
    assert "ACT" not in lines  # a single NFE makes no line


def test_changes_of_a_method_share_its_panel(tmp_path):
    """Chunks from no noise, and demonstrations without the hidden choice."""
    plain = make_run(tmp_path / "socket_ph32_exec16" / "default", "socket_ph32_exec16")
    unimodal = make_run(tmp_path / "socket_ph32_exec16" / "task.expert.modes=1", "socket_ph32_exec16")
    for run, protocol in ((plain, {}), (plain, {"noise_scale": 0.0}), (unimodal, {})):
        for nfe in (1, 2):
            write_evaluation(run, nfe, number=100, **protocol)
    found = [Result(evaluated) for evaluated in Sources([tmp_path]).others([])]
    panel, *_ = success_by_evaluations(found).axes
    assert panel.get_title(loc="left") == "iMF-AttnRes, two stages"
    labels = sorted(bars.get_label() for bars in panel.containers)
    assert labels == ["as in the tables", "chunks from no noise", "unimodal demonstrations"]


def test_losses_in_different_units_share_no_panel(tmp_path):
    """Improved Mean Flow, and flow matching with either output."""
    generators = {
        "imf": {"_target_": "imfvla.generators.imf.ImprovedMeanFlow", "parametrisation": "data"},
        "flow": {"_target_": "imfvla.generators.flow.FlowMatching", "parametrisation": "data"},
        "velocity": {"_target_": "imfvla.generators.flow.FlowMatching", "parametrisation": "velocity"},
    }
    for name, generator in generators.items():
        for seed in (0, 1):
            run = make_run(tmp_path / name / f"seed={seed}", name, seed=seed, generator=generator)
            write_evaluation(run, 1, number=100)
    figure = learning_curves([Result(evaluated) for evaluated in Sources([tmp_path]).others([])])
    panels = {axes.get_title(loc="left").replace("\n", " "): len(axes.lines) for axes in figure.axes}
    assert panels == {
        "improved Mean Flow": 2,
        "flow matching, clean action as output": 2,
        "flow matching, velocity as output": 2,
        "": 0,
    }
    assert {"imf", "imf, seed 1"} <= set(texts(figure))


def test_configs_from_before_a_key_share_the_panel_of_its_usual_value(tmp_path):
    regression = {"_target_": "imfvla.generators.regression.Regression"}
    for name, options in {"old": {}, "l1": {"power": 1}, "l2": {"power": 2}}.items():
        write_evaluation(
            make_run(tmp_path / name / "default", name, generator=regression | options), 1, number=100
        )
    figure = learning_curves([Result(evaluated) for evaluated in Sources([tmp_path]).others([])])
    panels = {axes.get_title(loc="left"): len(axes.lines) for axes in figure.axes if axes.lines}
    assert panels == {"L1 regression": 2, "L2 regression": 1}


@pytest.mark.parametrize(
    ("last", "scale", "label"), [(0.1, "log", "loss, log axis"), (-0.1, "linear", "loss")]
)
def test_a_loss_that_ends_below_zero_has_a_linear_axis(tmp_path, last, scale, label):
    run = make_run(tmp_path / "act" / "default", "act")
    (run / "metrics.jsonl").write_text(f'{{"step": 100, "loss": 1.0}}\n{{"step": 600, "loss": {last}}}\n')
    write_evaluation(run, 1, number=100)
    figure = learning_curves([Result(evaluated) for evaluated in Sources([tmp_path]).others([])])
    (axes,) = (axes for axes in figure.axes if axes.lines)
    assert (axes.get_yscale(), axes.get_ylabel()) == (scale, label)
    assert axes.lines[0].get_ydata().tolist() == [1.0, last]


def test_a_learning_curve_without_its_cut_off_last_line(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"step": 10, "loss": 2.0}\n{"step": 20, "loss": 1.0}\n{"step": 3')
    steps, loss = learning_curve(tmp_path)
    assert (steps.tolist(), loss.tolist()) == ([10, 20], [2, 1])
    path.write_text('{"step": 10, "loss": 2.0}\n{"st\n{"step": 20, "loss": 1.0}\n')
    with pytest.raises(UserError, match=r"metrics\.jsonl, line 2 is not JSON"):
        learning_curve(tmp_path)


def test_depth_weights_as_recorded(tmp_path):
    found = {"experiment": "e", "checkpoint_step": 5, "actions": [[1.0], [0.25, 0.75], [0.5, 0.25, 0.25]]}
    found["context"] = found["actions"]
    assert read_depth_attention(tmp_path) is None
    (tmp_path / FILE).write_text(json.dumps(found))
    figure = depth_attention([read_depth_attention(tmp_path)])
    assert not clipped(figure)
    assert {"e, step 5", "1.00", ".25", ".75", "emb.", "1 attn", "1 MLP"} <= set(texts(figure))
    image = figure.axes[0].images[0].get_array()
    np.testing.assert_array_equal(image.filled(-1), [[1, -1, -1], [0.25, 0.75, -1], [0.5, 0.25, 0.25]])
    assert figure.axes[0].images[0].get_clim() == (0, 1)  # so that no two weights look alike
    core = {"_target_": "imfvla.nn.cross.CrossAttentionCore"}
    shown = texts(depth_attention([read_depth_attention(tmp_path, core)]))
    assert {"1 attn", "1 cross", "1 MLP"} <= set(shown)


def test_no_depth_weights_and_broken_ones(tmp_path):
    figure = depth_attention([])
    assert not clipped(figure)
    assert "tools/depth_attention.py" in texts(figure)[0]
    for text in ("{", "[]", '{"actions": [[1.0]]}', '{"actions": []}'):
        (tmp_path / FILE).write_text(text)
        with pytest.raises(UserError, match=r"depth_attention\.json.*repeat python tools/depth_attention"):
            read_depth_attention(tmp_path)
