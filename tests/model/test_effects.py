"""The catalogue: what each object computes, what it says it needs, and that one more object is one more effect."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
import pytest
from project_paths import ROOT
from simulated_logs import TRUCK, drive, written

from estimator.answers.diagnosis import Verdict
from estimator.config import Config
from estimator.diagnosis.diagnose import diagnose
from estimator.errors import ConfigError
from estimator.model.effects import BY_NAME, CATALOGUE, SOURCES, Effect, Timing, View, named
from estimator.model.effects.effect import AtRest
from estimator.model.road_load import design
from estimator.roles import PAST_SPEEDS
from estimator.signals import Floats, Quantity, Role, Series
from estimator.streaming.drive_extraction import drives_of
from estimator.units import STANDARD_GRAVITY

PAGE = ROOT / "docs" / "effects.md"
ROAD_LOAD = np.array([1739.0, 3.74, 27_190.0])  # A, C, m
ALL = frozenset(Quantity)
ALWAYS_KNOWN = frozenset({Quantity.ELAPSED, *PAST_SPEEDS})
SHAPES = [pytest.param(e, shape, id=f"{e.name} {shape or ''}") for e in CATALOGUE for shape in e.shapes[:6]]
LAGS = {"time_lag", "speed_filter"}  # found by the alignment: there is no column for them


class Watched(Mapping[Quantity, Floats]):
    """A context that remembers what it was asked for."""

    def __init__(self, values: Mapping[Quantity, Floats]) -> None:
        self.values_, self.asked = values, set[Quantity]()

    def __getitem__(self, quantity: Quantity) -> Floats:
        self.asked.add(quantity)
        return self.values_[quantity]

    def __iter__(self) -> Iterator[Quantity]:
        return iter(self.values_)

    def __len__(self) -> int:
        return len(self.values_)


def view(n: int = 3000, **changes: object) -> View:
    """A few minutes of hills and bends, everything known; power as the plain road load has it."""
    t = 0.1 * np.arange(n)
    v, a = 15 + 6 * np.sin(t / 20), 0.3 * np.cos(t / 20)
    context: dict[Quantity, Floats] = {
        quantity: 1.5 + np.sin(t / (5 + i)) for i, quantity in enumerate(sorted(Quantity))
    }
    context |= {quantity: 0.01 * v * np.sin(t / 40) for quantity in BY_NAME["grade"].shapes}
    context |= {
        Quantity.ENGINE_SPEED: 120 + 20 * np.sin(t / 9),
        Quantity.ELAPSED: t,
        Quantity.HEADING: t / 50,
        Quantity.FAN_SPEED: np.where(np.sin(t / 30) > 0, 220.0, 22.0),
    }
    density = np.ones(n)
    values = {"t": t, "v": v, "a": a, "P": design(v, a, density) @ ROAD_LOAD, "density": density, "context": context}
    return View(**(values | {"road_load": ROAD_LOAD} | changes))  # type: ignore[arg-type]


def with_context(quantity: Quantity, value: float) -> View:
    plain = view()
    return replace(plain, context={**plain.context, quantity: np.full(len(plain.t), value)})


def with_past_speed(speed: float) -> View:
    plain = view()
    return replace(plain, context={**plain.context, **{q: np.full(len(plain.t), speed) for q in PAST_SPEEDS}})


@pytest.mark.parametrize(("effect", "shape"), SHAPES)
def test_power_is_one_finite_number_for_each_sample(effect, shape):
    power = effect.power(view(), shape)
    assert power.shape == (3000,)
    assert np.isfinite(power).all()
    assert power.any() == (effect.name not in LAGS)


@pytest.mark.slow
@pytest.mark.parametrize("size", [-2.0, 0.0, 1e-9, 7.4])
def test_power_is_finite_with_shapes_near_any_whatever_size_was_found(size):
    seen = view(300)
    for effect in (effect for effect in CATALOGUE if effect.finer_shapes):
        for shape in (shape for shape in effect.shapes if not isinstance(shape, Quantity)):
            for near in effect.finer_shapes(shape, size):
                assert np.isfinite(effect.power(seen, near)).all()


@pytest.mark.parametrize("name", ["warm_up", "oil_warm_up"])
def test_shapes_near_the_shortest_and_the_longest_low_pass_are_no_copies_of_each_other(name):
    """A time constant beyond those of the low-passed speeds has the column of the nearest."""
    effect, times = BY_NAME[name], PAST_SPEEDS.values()
    for time in (min(times), max(times)):
        shape = next(s for s in effect.shapes if s[1] == 1.5)
        near = effect.finer_shapes((time, *shape[1:]), 0.3)
        columns = {effect.power(view(), each).tobytes() for each in near}
        assert len(columns) == len(near)


@pytest.mark.parametrize(("effect", "shape"), SHAPES)
def test_what_is_computed_from_is_what_is_declared(effect, shape):
    context = Watched(view().context)
    effect.power(view(context=context), shape)
    declared = {*effect.needs, *([shape] if isinstance(shape, Quantity) else [])}
    there_are = {Quantity.BATTERY_CURRENT, Quantity.BRAKE}  # effects of batteries ask only that they are there
    assert context.asked - there_are == declared - there_are


@pytest.mark.parametrize(("effect", "need"), [(e, need) for e in CATALOGUE for need in e.needs])
def test_hiding_one_need_makes_it_untestable(effect, need):
    assert effect.usable_shapes(ALL) == effect.shapes
    assert effect.usable_shapes(ALL - {need}) == ()


@pytest.mark.parametrize(
    ("effect", "source"), [(e, shape) for e in CATALOGUE for shape in e.shapes if isinstance(shape, Quantity)]
)
def test_one_source_of_several_will_do(effect, source):
    others = {shape for shape in effect.shapes if isinstance(shape, Quantity)} - {source}
    assert source in effect.usable_shapes(ALL - others)
    assert source not in effect.usable_shapes(ALL - {source})
    others_known = frozenset(effect.needs)
    assert set(SOURCES[source]) <= set(effect.wanted(others_known).split(" or "))


def test_what_is_missing_can_be_named():
    for effect in CATALOGUE:
        needs = [quantity for quantity in effect.needs if quantity not in ALWAYS_KNOWN]
        assert effect.usable_shapes(ALWAYS_KNOWN) or effect.wanted(ALWAYS_KNOWN), effect.name
        assert all(" or ".join(SOURCES[quantity]) in effect.wanted(ALWAYS_KNOWN) for quantity in needs)
        assert effect.wanted(ALL) == ""
    assert BY_NAME["cornering"].wanted(ALWAYS_KNOWN) == "lateral_acceleration or yaw_rate"
    loss = BY_NAME["regeneration_loss"]
    assert loss.wanted(ALWAYS_KNOWN) == "battery_current, and brake_switch or brake_pedal"
    assert loss.wanted({*ALWAYS_KNOWN, Quantity.BRAKE}) == "battery_current"


STANDSTILL = replace(view(), v=np.full(3000, 1e-9), P=np.zeros(3000))
LEVEL = {
    "grade": view(context=dict.fromkeys(Quantity, np.zeros(3000))),
    "headwind": view(v=np.zeros(3000), context={Quantity.HEADING: np.full(3000, np.pi / 2)}),
    "air_density": STANDSTILL,
    "warm_up": with_past_speed(80 / 3.6),
    "viscous_drag": STANDSTILL,
    "oil_warm_up": with_past_speed(80 / 3.6),
    "cold_loss": with_context(Quantity.ELAPSED, 1e6),
    "torque_gain": view(P=np.zeros(3000)),
    "load_loss": view(P=np.zeros(3000)),
    "torque_bias": with_context(Quantity.ENGINE_SPEED, 0.0),
    "rotating_inertia": view(a=np.zeros(3000)),
    "mass_step": view(a=np.full(3000, -ROAD_LOAD[0] / ROAD_LOAD[2])),
    "resistance_segment": STANDSTILL,
    "cornering": with_context(Quantity.LATERAL_ACCELERATION, 0.0),
    "sensor_drift": with_context(Quantity.ELAPSED, 0.0),
    "speed_scale": view(P=np.zeros(3000)),
    "brake_use": STANDSTILL,
    "drafting": STANDSTILL,
    "regeneration_loss": view(P=np.full(3000, 1e4)),
    "cabin_heater": with_context(Quantity.ELAPSED, 1e6),
}


@pytest.mark.parametrize("name", LEVEL)
def test_nothing_is_added_where_nothing_acts(name):
    effect = BY_NAME[name]
    np.testing.assert_allclose(effect.power(LEVEL[name], effect.shapes[0]), 0.0, atol=1e-3)


def test_loads_of_the_engine_do_not_go_with_the_speed():
    for name in ("auxiliary_load", "auxiliary_cycling"):
        np.testing.assert_array_equal(BY_NAME[name].power(STANDSTILL, None), 1.0)


def test_what_is_taken_at_rest_is_the_power_there():
    then = {Quantity.ENGINE_SPEED: np.full(3000, 70.0), Quantity.ELAPSED: np.full(3000, 240.0)}
    idling = replace(STANDSTILL, context={**STANDSTILL.context, **then})
    rest = AtRest(power=0.0, sd=1.0, engine_speed=70.0, elapsed=240.0)
    takers = {effect.name for effect in CATALOGUE if effect.at_rest is not None}
    assert takers == {"auxiliary_load", "torque_bias", "cabin_heater"}
    for effect in (BY_NAME[name] for name in takers):
        for shape in effect.shapes:
            np.testing.assert_allclose(effect.power(idling, shape), effect.at_rest(rest, shape))


def test_powers_are_those_of_the_equations():
    seen = view()
    v, C = seen.v, ROAD_LOAD[1]
    ahead = with_context(Quantity.HEADING, 0.0)
    for wind in (5.0, 9.0):
        shape = 0.0, 0.1, 0.25, wind
        np.testing.assert_allclose(wind * BY_NAME["headwind"].power(ahead, shape), C * ((v + wind) ** 2 - v**2) * v)
        aside = with_context(Quantity.HEADING, np.pi / 2)
        yaw = np.minimum(np.degrees(np.arctan2(wind, v)), np.degrees(0.25))
        oblique = C * ((1 + 0.1 * (yaw / 10) ** 2) * np.hypot(v, wind) * v - v**2) * v
        np.testing.assert_allclose(wind * BY_NAME["headwind"].power(aside, shape), oblique, rtol=1e-9)
    climb = v * 0.02
    hill = view(context={Quantity.CLIMB_BY_GRADE: climb})
    weight = ROAD_LOAD[2] * BY_NAME["grade"].power(hill, Quantity.CLIMB_BY_GRADE)
    np.testing.assert_allclose(weight, ROAD_LOAD[2] * STANDARD_GRAVITY * climb)
    np.testing.assert_allclose(BY_NAME["mass_step"].power(seen, None), (ROAD_LOAD[0] + ROAD_LOAD[2] * seen.a) * v)
    thin = view(density=np.full(3000, 0.9))
    np.testing.assert_allclose(BY_NAME["drafting"].power(thin, None), -0.9 * C * v**3)
    cold = with_context(Quantity.ELAPSED, 600.0)
    for name, power in {"cold_loss": np.abs(seen.P), "cabin_heater": 1.0}.items():
        np.testing.assert_allclose(BY_NAME[name].power(cold, 600.0), power / np.e)
    lukewarm = with_past_speed(80 / 3.6 * (1 - 1 / np.e))
    half_churned = 0.5 * v * (80 / 3.6 + v)
    for name, of, power in (
        ("warm_up", (), ROAD_LOAD[0] * v),
        ("oil_warm_up", (1.0,), v**2),
        ("oil_warm_up", (0.5,), half_churned),
    ):
        np.testing.assert_allclose(BY_NAME[name].power(lukewarm, (600.0, 0.0, *of)), power / np.e)
        softened = power * (np.exp(2 / np.e) - 1) / (np.exp(2) - 1)
        np.testing.assert_allclose(BY_NAME[name].power(lukewarm, (600.0, 2.0, *of)), softened)
        np.testing.assert_allclose(BY_NAME[name].power(lukewarm, (600.0, 1e-6, *of)), power / np.e, rtol=1e-5)
    half_an_hour = with_context(Quantity.ELAPSED, 1800.0)
    np.testing.assert_allclose(BY_NAME["air_density"].power(half_an_hour, None), 0.5 * C * v**3)
    np.testing.assert_allclose(
        BY_NAME["regeneration_loss"].power(view(P=np.linspace(-2, 1, 3000)), None)[[0, -1]], [2, 0]
    )
    fan = BY_NAME["auxiliary_cycling"].power(seen, Quantity.FAN_SPEED)
    np.testing.assert_allclose([fan.max(), fan.min()], [1.0, 0.001])  # a tenth of the speed, a thousandth of the power


@pytest.mark.parametrize(("effect", "shape"), SHAPES)
def test_the_power_at_a_time_is_the_same_whatever_else_is_looked_at(effect, shape):
    """A fit on some stretches gives a magnitude that holds on the others."""
    whole, some = view(), slice(1200, 1500)
    part = replace(
        whole,
        **{name: getattr(whole, name)[some] for name in ("t", "v", "a", "P", "density")},
        context={quantity: values[some] for quantity, values in whole.context.items()},
    )
    np.testing.assert_allclose(effect.power(part, shape), effect.power(whole, shape)[some], rtol=1e-12)


@pytest.mark.parametrize("effect", [e for e in CATALOGUE if e.is_absorbed and e.name not in LAGS], ids=lambda e: e.name)
def test_what_is_absorbed_lies_in_the_plain_columns(effect):
    seen = view()
    X = design(seen.v, seen.a, seen.density)
    power = effect.power(seen, None)
    left = power - X @ np.linalg.lstsq(X, power, rcond=None)[0]
    assert np.abs(left).max() < 1e-6 * np.abs(power).max()


@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda e: e.name)
def test_usual_sizes_suit_a_car_as_well_as_a_truck(effect):
    car = np.array([150.0, 0.4, 1500.0])
    truck, small = effect.usual_magnitude(ROAD_LOAD), effect.usual_magnitude(car)
    assert np.isfinite([truck, small]).all()
    assert min(truck, small) > 0
    for road_load, size in ((ROAD_LOAD, truck), (car, small)):
        seen = view(road_load=road_load)
        seen = replace(seen, P=design(seen.v, seen.a, seen.density) @ road_load)
        power = size * effect.power(seen, effect.shapes[0])
        assert float(np.sqrt(np.mean(power**2))) < 2 * float(np.sqrt(np.mean(seen.P**2)))


def test_names_and_equivalents_are_sound():
    assert list(BY_NAME) == [effect.name for effect in CATALOGUE]
    for effect in CATALOGUE:
        assert all((effect.equation, effect.source, effect.symbol, effect.unit, effect.shown_by))
        assert all(effect.name in BY_NAME[other].equivalent for other in effect.equivalent)
        assert effect.is_streaming or effect.timing is not Timing.ALWAYS or effect.is_absorbed


def test_what_switches_streams_with_a_signal_only():
    fan = BY_NAME["auxiliary_cycling"]
    assert fan.streaming_shapes(ALL) == (Quantity.FAN_SPEED,)
    assert fan.streaming_shapes(ALL - {Quantity.FAN_SPEED}) == ()
    for effect in CATALOGUE:
        assert effect.is_streaming == (not effect.is_absorbed and bool(effect.streaming_shapes(ALL)))


def test_a_configuration_asks_by_name():
    assert [effect.name for effect in named(["headwind", "grade", "headwind"])] == ["headwind", "grade"]
    with pytest.raises(ConfigError, match=r"'drafing' is not known; did you mean drafting\?$"):
        named(["drafing"])
    with pytest.raises(
        ConfigError, match=r"'gravity' is not known; there are grade, headwind, .*, cabin_heater$"
    ) as refused:
        named(["gravity"])
    offered = str(refused.value).partition("there are ")[2].split(", ")
    assert [effect.name for effect in named(offered)] == offered
    with pytest.raises(ConfigError, match=r"'drafting' cannot be part of the model.*those that can: grade, headwind"):
        named(["grade", "drafting"])


@pytest.fixture
def effects_table():
    return pytest.importorskip("effects_table")


def test_the_page_is_what_the_tool_prints(effects_table):
    assert PAGE.read_text(encoding="utf-8") == effects_table.page()


def test_the_page_has_every_effect_with_what_it_needs():
    text = PAGE.read_text(encoding="utf-8")
    for effect in CATALOGUE:
        rows = [line for line in text.splitlines() if line.startswith(f"| `{effect.name}` |")]
        assert len(rows) == 2
        assert effect.equation in rows[0]
        assert effect.unit in rows[0]
        assert effect.shown_by in rows[1]
        needed = [*effect.needs, *(shape for shape in effect.shapes if isinstance(shape, Quantity))]
        assert all(f"`{role.value}`" in rows[1] for quantity in needed for role in SOURCES.get(quantity, ()))


def example() -> Effect:
    """The effect that the page adds, in ten lines."""
    block = re.search(r"```python\n(Effect\(.*?\))\n```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert block is not None
    assert block[1].count("\n") == 9
    effect: Effect = eval(block[1], {"Effect": Effect, "np": np})
    return effect


@pytest.mark.slow
def test_one_object_more_is_one_effect_more(tmp_path):
    """The page's effect acts on a truck: something without a name, until there is an object of that name."""
    shimmy, size = example(), 800.0
    recording = drive("mixed", 16, 32, torque_resolution=0.01)
    truth = recording.truth
    power = size * shimmy.power(view(v=truth.v), None)
    torque = recording.signals[Role.TORQUE_FRACTION]
    more = np.interp(torque.t, truth.t, power / truth.engine_speed) / TRUCK.reference_torque
    signals = {**recording.signals, Role.TORQUE_FRACTION: Series(torque.t, torque.value + more)}
    log = written(replace(recording, signals=signals), tmp_path / "shimmy.blf")
    records = drives_of(log, Config(), lambda share: None)

    others = [BY_NAME[name] for name in ("auxiliary_load", "viscous_drag", "brake_use", "headwind", "warm_up")]
    before = diagnose(records, (), np.random.default_rng(1), others)
    assert before.verdict is Verdict.UNKNOWN
    after = diagnose(records, (), np.random.default_rng(1), (*others, shimmy))
    assert after.verdict is Verdict.EFFECT
    (found,) = after.effects
    assert found.name == "shimmy"
    assert found.magnitude.value == pytest.approx(size, abs=4 * found.magnitude.sd)
    assert found.magnitude.sd < 0.15 * size
    assert found.rms_after < found.rms_before
    assert after.final.mass == pytest.approx(TRUCK.mass, rel=0.02)
