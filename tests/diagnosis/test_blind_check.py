"""The blind check judges what it claims to judge; and a fixed set of drives is diagnosed as well as promised."""

import dataclasses
import json
import sys

import grimp
import numpy as np
import pytest
from msgspec.structs import replace

from estimator.answers.answer import encode
from estimator.answers.diagnosis import GapClosed, Part, Verdict
from estimator.diagnosis.result import Diagnosis
from estimator.report.diagnosis_summary import of_diagnosis
from estimator.signals import Role

DRIVES, MINUTES, SEED = 9, 20.0, 7  # of the fixed set

FAKE = """
import sys
from pathlib import Path
assert not list(Path.cwd().glob("**/sealed")), "a truth lies within reach"
name = Path(sys.argv[1]).stem
if name.endswith("1"):
    sys.exit("error: no power in the log")
print(Path(__file__).with_name("answer.json").read_text())
"""


def answer(verdict, effects=(), candidates=()):
    """What `roadload diagnose` says; of all else it knows nothing."""
    nothing = of_diagnosis(Diagnosis(verdict=Verdict.CANNOT_TELL))
    return replace(nothing, verdict=Verdict(verdict), effects=effects, candidates=candidates)


def truth_of(drive="drive-0000", kind="single", names=("grade",), log_bayes_factor=100.0, **changes):
    from blind.truth import Active, Truth, key_of

    effects = tuple(Active(name, name, 1.0, 5.0, 4.0, log_bayes_factor, changes.pop("spans", None)) for name in names)
    gap_closed = {key_of(names): 1.0, **{name: 0.5 for name in names if len(names) > 1}}
    fields = {
        "drive": drive,
        "nonce": "00",
        "seed": 0,
        "kind": kind,
        "minutes": 40.0,
        "route": "mixed one-way",
        "parameters": {},
        "effects": effects,
        "shown": (),
        "companions": (),
        "gap_closed": gap_closed,
        "driven": ((0.0, 1000.0),),
        "speed_noise": 0.008,
        "torque_resolution": 0.01,
        "nuisances": {},
        "without": (),
        **changes,
    }
    return Truth(**fields)


def run_of(verdict, *names, drive="drive-0000", probability=0.95, fraction=1.0, equivalent=(), span=()):
    from blind.answer import Run, bare

    closed = GapClosed(fraction=fraction, q05=fraction - 0.05, q95=fraction + 0.05)
    findings = tuple(
        replace(bare(name, probability), equivalent=equivalent, gap_closed=closed, span_s=span) for name in names
    )
    return Run(drive, 4.0, 4.0, 200.0, answer(verdict, findings, findings))


def measures(*cases):
    from blind.case import Case
    from blind.score import score

    return {m.name: m for m in score([Case(truth, run) for truth, run in cases]).measures}


def test_drives_are_dealt_in_the_promised_shares_and_every_effect_and_noise_level_has_its_turn():
    from blind.draw import CATALOGUE, OUTSIDE, SPEED_NOISE, draw

    from estimator.simulation.effects.catalogue import KINDS

    plans = draw(200, seed=3, minutes=40.0)
    kinds = [plan.kind for plan in plans]

    assert [kinds.count(kind) for kind in ("clean", "single", "pair", "outside")] == [50, 90, 30, 30]
    assert {name for p in plans if p.kind == "single" for name in p.effects} == set(CATALOGUE)
    assert {name for p in plans if p.kind == "outside" for name in p.effects} == set(OUTSIDE)
    assert all(len(p.effects) == {"clean": 0, "pair": 2}.get(p.kind, 1) for p in plans)
    clean = [p.sensors for p in plans if p.kind == "clean"]
    assert [sum(s.speed_noise == level for s in clean) for level in SPEED_NOISE] == [10] * 5
    sizes = [(abs(size), KINDS[name]) for p in plans for name, size in p.effects.items()]
    assert all(kind.low - 1e-12 <= size <= kind.high + 1e-12 for size, kind in sizes)
    assert all(0.03 <= p.sensors.torque_lag <= 0.1 and p.sensors.torque_noise > 0 for p in plans)
    assert all({Role.LATITUDE, Role.LONGITUDE} <= p.sensors.without for p in plans)


def test_drives_and_their_truth_owe_nothing_to_the_model_under_test():
    graph = grimp.build_graph("blind", "estimator", cache_dir=None)
    makers = ("blind.draw", "blind.oracle", "blind.seal", "blind.truth", "blind.world")
    under_test = ("estimator.diagnosis", "estimator.estimation", "estimator.model")
    chains = (graph.find_shortest_chain(one, other, as_packages=True) for one in makers for other in under_test)
    assert [chain for chain in chains if chain] == []


def test_noise_of_the_oracle_is_that_of_the_generator():
    from blind.oracle import BLOCK, Noise, covariance

    from estimator.simulation.noise import correlated

    rng = np.random.default_rng(1)
    noise = Noise(
        torque_sd=10.0,
        torque_time=2.0,
        torque_white_sd=5.0,
        torque_step=3.0,
        torque_period=0.02,
        speed_sd=0.01,
        speed_step=0.0,
        speed_period=0.1,
    )
    n, w, momentum = 40_000, 120.0, 4e5
    readings = round(BLOCK / noise.torque_period)
    torque = correlated(n * readings, noise.torque_sd, noise.torque_time / noise.torque_period, rng)
    torque += rng.normal(0.0, noise.torque_white_sd, len(torque))
    torque = np.round(torque / noise.torque_step) * noise.torque_step
    speeds = rng.normal(0.0, noise.speed_sd, (n + 1) * round(BLOCK / noise.speed_period)).reshape(n + 1, -1)
    power = w * torque.reshape(n, readings).mean(axis=1) + momentum * np.diff(speeds.mean(axis=1)) / BLOCK

    band = covariance(np.full(n, w), np.full(n, momentum), np.ones(n, dtype=bool), noise)
    found = [np.mean(power[: n - k] * power[k:]) for k in (0, 1, 2, 4)]
    np.testing.assert_allclose(found, band[[0, 1, 2, 4], 100], atol=0.06 * found[0])


def test_expected_log_bayes_factor_is_the_mean_of_exact_ones():
    from blind.oracle import Driven, log_bayes_factor, signal_to_noise

    rng = np.random.default_rng(2)
    n, sd = 400, 3.0
    X, d = rng.normal(size=(n, 3)), rng.normal(size=n)
    blank = Driven(X=X, rate=np.zeros(n), effects=d[:, None], used=np.ones(n, dtype=bool), band=np.full((1, n), sd**2))
    s2 = signal_to_noise(blank, 0)
    off = d - X @ np.linalg.lstsq(X, d, rcond=None)[0]
    assert s2 == pytest.approx(off @ off / sd**2)

    noise = rng.normal(0.0, sd, (4000, n)) @ off / sd**2
    exact = 0.5 * (s2 + noise) ** 2 / (1 + s2) - 0.5 * np.log1p(s2)  # over the evidence without the effect
    expected_noise = 0.5 * s2 / (1 + s2)  # of the noise alone, which the oracle leaves out
    assert np.mean(exact) - expected_noise == pytest.approx(log_bayes_factor(s2), rel=0.02)


def test_gap_closed_is_whole_with_all_effects_and_partial_with_one():
    from blind.oracle import Driven, gap_closed

    rng = np.random.default_rng(4)
    n = 20_000
    first, second = (
        Driven(
            X=rng.normal(size=(n, 3)),
            rate=np.zeros(n),
            effects=rng.normal(size=(n, 2)) * [3.0, 1.0],
            used=np.ones(n) > 0,
            band=np.ones((1, n)),
        )
        for _ in range(2)
    )

    assert gap_closed(first, second, (0, 1)) == pytest.approx(1.0)
    assert gap_closed(first, second, (0,)) == pytest.approx(0.9, abs=0.03)
    assert gap_closed(first, second, (1,)) == pytest.approx(0.1, abs=0.03)


@pytest.mark.slow
def test_scores_tell_right_from_wrong():
    right = measures(
        (truth_of(), run_of("effect", "grade")),
        (truth_of(kind="clean", names=()), run_of("no gap")),
        (truth_of(kind="outside", names=("snow_plough",)), run_of("unknown effect")),
        (truth_of(kind="pair", names=("grade", "warm_up")), run_of("effect", "warm_up", "grade")),
        (truth_of(log_bayes_factor=0.2), run_of("cannot tell")),
    )
    wrong = measures(
        (truth_of(), run_of("effect", "headwind")),
        (truth_of(kind="clean", names=()), run_of("effect", "load_loss")),
        (truth_of(kind="outside", names=("snow_plough",)), run_of("effect", "grade")),
        (truth_of(kind="pair", names=("grade", "warm_up")), run_of("effect", "drafting")),
        (truth_of(log_bayes_factor=0.2), run_of("unknown effect")),
    )
    for name, good, bad in (
        ("named first, or its class: oracle > 10", 1.0, 0.0),
        ("false alarm on a clean drive", 0.0, 1.0),
        ("outside the catalogue: unknown effect", 1.0, 0.0),
        ("outside the catalogue: a wrong name", 0.0, 1.0),
        ("two effects: both named", 1.0, 0.0),
        ("two effects: at least one named", 1.0, 0.0),
        ("two effects: a wrong name besides", 0.0, 1.0),
        ("nothing claimed: oracle < 1, or modelled by default", 1.0, 0.0),
    ):
        assert (right[name].estimate.value, wrong[name].estimate.value) == (good, bad), name
        assert right[name].estimate.low < 1.0 or right[name].estimate.n == 0
        assert wrong[name].failures == ("drive-0000",)


@pytest.mark.slow
def test_what_cannot_be_told_apart_counts_and_the_rest_does_not():
    name = "named first, or its class: oracle > 10"
    lag = truth_of(names=("time_lag",))

    assert measures((lag, run_of("effect", "speed_filter")))[name].estimate.value == 1.0
    assert measures((lag, run_of("effect", "grade", equivalent=("time_lag",))))[name].estimate.value == 1.0
    assert measures((lag, run_of("effect", "grade")))[name].estimate.value == 0.0
    assert measures((lag, run_of("cannot tell", "time_lag")))[name].estimate.value == 0.0


@pytest.mark.slow
def test_a_name_of_two_that_the_drive_does_not_part_is_not_one_name_alone():
    tyres, name = truth_of(names=("warm_up",)), "... by one name alone, oracle > 10"
    one, two = run_of("effect", "warm_up"), run_of("effect", "warm_up", equivalent=("oil_warm_up",))
    lag = truth_of(names=("time_lag",)), run_of("effect", "time_lag", equivalent=("speed_filter",))
    assert [measures(case)[name].estimate.value for case in ((tyres, one), (tyres, two), lag)] == [1.0, 0.0, 1.0]


@pytest.mark.slow
def test_promised_shares_and_places_are_held_against_the_oracle():
    bounded = truth_of(names=("drafting",), spans=((100.0, 300.0), (500.0, 600.0)))
    found = measures((bounded, run_of("effect", "drafting", fraction=0.9, span=((100.0, 300.0),))))

    assert found["gap closed within 3 points of the oracle"].estimate.value == 0.0
    assert found["median error of the gap closed"].estimate.value == pytest.approx(-10.0)
    assert found["localisation of bounded effects: median IoU"].estimate.value == pytest.approx(2 / 3)
    half = truth_of(kind="pair", names=("grade", "drafting"))
    found = measures((half, run_of("effect", "grade", fraction=0.51)))
    assert found["gap closed within 3 points of the oracle"].estimate.value == 1.0


def test_a_grade_closes_what_a_known_road_would_close_whatever_its_signals_show():
    """The oracle knows the road exactly; ``gap_closed`` of the finding is what a poor altimeter closes."""
    from blind.answer import closed_if_known

    def part(cause, share):
        return Part(
            cause=cause,
            share=share,
            q05=share - 0.01,
            q95=share + 0.01,
            rms_kW=None,
            reached_kW=None,
            expected_kW=None,
        )

    run = run_of("effect", "grade", "drafting", fraction=0.8)
    (grade, drafting), said = run.named, run.answer
    parts = (part("road", 0.9), part("sensor noise", 0.03), part("unknown: white force", 0.01))
    shown = replace(run, answer=replace(said, budget=parts))
    closed = closed_if_known(shown, grade)
    assert (closed.fraction, closed.q05, closed.q95) == pytest.approx((0.9 / 0.96, 0.89 / 0.96, 0.91 / 0.96))
    assert closed_if_known(shown, drafting) == drafting.gap_closed
    assert closed_if_known(run, grade) == grade.gap_closed


def test_overlap_counts_only_where_the_truck_is_driven():
    from blind.answer import overlap

    assert overlap(((0.0, 10.0),), ((5.0, 15.0),), ((0.0, 100.0),)) == pytest.approx(1 / 3)
    assert overlap(((0.0, 10.0),), ((5.0, 15.0),), ((5.0, 10.0), (20.0, 30.0))) == pytest.approx(1.0)
    assert overlap((), (), ((0.0, 1.0),)) == 0.0


def test_credible_sets_hold_what_they_promise():
    from blind.answer import Run, bare, credible_set

    def chosen(**probabilities):
        ranked = tuple(bare(name, p) for name, p in probabilities.items())
        return [f.name for f in credible_set(Run("", 1.0, 1.0, 1.0, answer("effect", candidates=ranked)))]

    assert chosen(grade=0.95, headwind=0.05) == ["grade"]
    assert chosen(grade=0.6, headwind=0.35) == ["grade", "headwind"]
    assert chosen(grade=0.35, headwind=0.05) == ["none", "grade"]


def test_calibration_error_of_the_sure_and_always_wrong_is_one():
    from harness.scores import calibration_error

    assert calibration_error(np.ones(10), np.zeros(10)) == 1.0
    assert calibration_error(np.full(10, 0.5), np.arange(10) % 2.0) == pytest.approx(0.0)


def test_seal_refuses_what_was_changed_afterwards(tmp_path):
    from blind import seal

    for name in ("logs", "sealed"):
        (tmp_path / name).mkdir()
    seal.log_of(tmp_path, "drive-0000").write_bytes(b"a log")
    seal.publish(tmp_path, {"drive-0000": seal.seal(tmp_path, truth_of())})
    assert seal.unseal(tmp_path) == {"drive-0000": truth_of()}

    path = seal.truth_of(tmp_path, "drive-0000")
    path.write_bytes(path.read_bytes().replace(b"grade", b"fudge"))
    with pytest.raises(seal.SealError, match=r"drive-0000\.json"):
        seal.unseal(tmp_path)


def test_answers_are_kept_with_their_cost_and_failures_with_their_reason(tmp_path):
    from blind import diagnose, seal
    from blind.answer import bare

    for name in ("logs", "sealed"):
        (tmp_path / name).mkdir()
    entries = {}
    for drive in ("drive-0000", "drive-0001"):
        seal.log_of(tmp_path, drive).write_bytes(b"a log")
        entries[drive] = seal.seal(tmp_path, truth_of(drive))
    seal.publish(tmp_path, entries)
    script = tmp_path / "fake.py"
    script.write_text(FAKE)
    script.with_name("answer.json").write_bytes(encode(answer("effect", (bare("grade", 0.9),))))
    assert len(list(diagnose.diagnose_all(tmp_path, 2, (sys.executable, str(script))))) == 2
    runs = diagnose.answers(tmp_path)

    assert runs["drive-0000"].named[0].name == "grade"
    assert runs["drive-0000"].seconds > 0.0
    assert (runs["drive-0001"].verdict, runs["drive-0001"].error) == ("error", "error: no power in the log")


@pytest.mark.slow
def test_logs_and_truths_lie_apart_and_come_again_from_the_same_seed(tmp_path):
    from blind import draw, seal, world

    plans = draw.draw(2, seed=5, minutes=2.0, hilly=1.0)
    for out in ("one", "two"):
        list(world.make_all(plans, 5, tmp_path / out, workers=1))
    one, two = (seal.unseal(tmp_path / out) for out in ("one", "two"))

    for drive, truth in one.items():
        again = two[drive]
        assert (truth.effects, truth.gap_closed, truth.parameters) == (
            again.effects,
            again.gap_closed,
            again.parameters,
        )
        assert (
            seal.log_of(tmp_path / "one", drive).read_bytes()[200:]
            == seal.log_of(tmp_path / "two", drive).read_bytes()[200:]
        )
    kept = sorted(path.name for path in (tmp_path / "one" / "logs").iterdir())
    given = [f"{p.drive}.toml" for p in plans if p.given]
    assert given
    assert kept == sorted(["manifest.json", *given, *(f"{drive}.blf" for drive in one)])


def test_the_sealed_drag_is_that_of_the_air_at_the_start_where_no_signal_shows_how_it_changes():
    from blind import draw, world

    plan = draw.draw(1, seed=5, minutes=4.0)[0]
    thermometer = {Role.AMBIENT_TEMPERATURE, Role.AIR_PRESSURE}
    hidden = dataclasses.replace(plan.sensors, without=plan.sensors.without | thermometer)
    shown = dataclasses.replace(plan.sensors, without=plan.sensors.without - thermometer)

    def drag(sensors, **effects):
        return world.sealed_drag(dataclasses.replace(plan, sensors=sensors, effects=effects)) / plan.truck.C

    assert drag(hidden, air_density=20.0) == pytest.approx(288.15 / 278.15)
    assert drag(shown, air_density=20.0) == 1.0
    assert drag(hidden, headwind=4.0) == 1.0


def test_scores_of_nothing_are_refused_in_one_line(tmp_path, capsys):
    import check_blind

    assert check_blind.main(["score", str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith(f"error: {tmp_path}")


def test_prior_odds_are_best_where_probabilities_are_frequencies():
    import check_priors

    # Nothing acts on 30 of 40 drives whose answers say 0.5, and on 9 of 10 that say 0.75: a third of the odds is right.
    none = np.repeat([0.5, 0.75], [40, 10])
    is_none = np.concatenate([np.arange(40) < 30, np.arange(10) < 9])
    assert check_priors.best_factor(none, is_none) == pytest.approx(1 / 3, rel=1e-3)
    assert check_priors.with_factor(none, 1 / 3)[[0, -1]] == pytest.approx([0.75, 0.9])
    expected = 30 * np.log(0.75) + 10 * np.log(0.25) + 9 * np.log(0.9) + np.log(0.1)
    assert check_priors.log_score(none, is_none, 1 / 3) == pytest.approx(expected)


def test_pages_and_json_show_every_measure():
    from blind import tables
    from blind.case import Case
    from blind.score import score
    from harness.check import plain

    result = score(
        [Case(truth_of(), run_of("effect", "grade")), Case(truth_of(kind="clean", names=()), run_of("no gap"))]
    )
    figures = json.loads(json.dumps(plain(dataclasses.asdict(result)), allow_nan=False))
    page = "\n".join(table.markdown() for table in tables.tables(figures))

    assert all(measure.name in page for measure in result.measures)
    assert "| named first, or its class: oracle > 10 | >= 95 % | 100.0 % |" in page
    assert "| clean | no gap |" in page


def diagnosed(folder, kinds=None):
    """Cases of the fixed set, made and diagnosed; of ``kinds`` alone the first drive of each."""
    from blind import diagnose, draw, score, seal, world

    plans = draw.draw(DRIVES, SEED, MINUTES)
    if kinds is not None:
        plans = [next(plan for plan in plans if plan.kind == kind) for kind in kinds]
    list(world.make_all(plans, SEED, folder, workers=2))
    list(diagnose.diagnose_all(folder, workers=2))
    return score.pair(seal.unseal(folder), diagnose.answers(folder))


def missed(cases, *names):
    """Drives that fail a measure of ``names``, each of which judges one at least."""
    from blind.score import score

    result = score(cases)
    assert result.failed == ()
    found = {m.name: m for m in result.measures}
    assert all(found[name].estimate.n for name in names)
    return [drive for name in names for drive in found[name].failures]


CLEAN, SINGLE = "false alarm on a clean drive", "named first, or its class: oracle > 10"


@pytest.mark.slow
def test_a_clean_drive_and_one_with_an_effect_are_diagnosed_as_promised(tmp_path):
    """The first of either kind of the fixed set; the oracle tells what has to be named."""
    assert missed(diagnosed(tmp_path, ("clean", "single")), CLEAN, SINGLE) == []


@pytest.mark.nightly
def test_the_fixed_set_is_diagnosed_as_promised(tmp_path):
    """All that the oracle sees is named, so that one name fewer is noticed; larger sets are for the full run."""
    assert missed(diagnosed(tmp_path), CLEAN, SINGLE, "two effects: both named") == []
