"""What the torque leaves out is a known doubt: A and C are wider, and a warning has the line that binds it."""

import numpy as np
import pytest

from estimator.can_io.j1939_encoder import frames_of
from estimator.config import Config, from_dict
from estimator.estimates import Estimate
from estimator.model.effects import unbound
from estimator.report.run_warnings import warnings_of
from estimator.signals import Role
from estimator.simulation.recording import simulate
from estimator.simulation.truck import Truck
from estimator.streaming.pipeline import Pipeline

TRUCK = Truck(mass=27_190.0, A=1739.0, C=3.74)


def without(*roles: Role) -> Config:
    signals = {role: path for role, path in Config().binding.items() if role not in roles}
    return from_dict({"signals": signals, "gate": {"interval_s": 3600.0}})


def test_a_warning_has_the_line_that_binds_what_is_missing():
    assert warnings_of(Config(), {}) == ()
    (warning,) = warnings_of(without(Role.FRICTION_FRACTION), {})
    assert 'friction_fraction = "EEC3.NominalFrictionPercentTorque"' in warning
    assert len(warnings_of(without(Role.FRICTION_FRACTION, Role.TORQUE_FRACTION_FINE), {})) == 2


def test_a_warning_on_a_table_has_the_option_that_names_a_column():
    columns = {"speed": "v [km/h]", "torque_fraction": "T [%]", "engine_speed": "n [rpm]"}
    friction, fine = warnings_of(from_dict({"table": {"columns": columns}}), {})
    assert friction.endswith('widens them; if the table has a column of it, add --map friction_fraction="COLUMN [%]"')
    assert fine.endswith('add --map torque_fraction_fine="COLUMN [%]"')


def test_wheels_that_were_left_out_are_told_with_their_rows():
    errors = {"wheel_speeds 3: differs from the others": 11_954, "CCVS1: too short": 3}
    assert warnings_of(Config(), errors) == ("wheel_speeds 3: differs from the others, in 11,954 rows",)


ELECTRIC = {"speed": "CAR.V", "battery_voltage": "CAR.U", "battery_current": "CAR.I"}


def test_power_of_a_battery_is_told_to_hold_losses_and_consumers():
    (warning,) = warnings_of(from_dict({"signals": ELECTRIC}), {})
    assert "driveline_efficiency = 0.9" in warning
    assert 'effects = ["auxiliary_load"]' in warning
    for given in ({"effects": ["auxiliary_load"]}, {"vehicle": {"driveline_efficiency": 0.9}}):
        assert warnings_of(from_dict({"signals": ELECTRIC} | given), {}) == ()


def test_a_table_with_voltage_and_current_is_told_so_too():
    columns = {"speed": "speed [km/h]", "battery_voltage": "U [V]", "battery_current": "I [A]"}
    (warning,) = warnings_of(from_dict({"table": {"columns": columns}}), {})
    assert warning.startswith("the power is that of the battery")
    assert warnings_of(from_dict({"table": {"columns": columns | {"power": "P [kW]"}}}), {}) == ()


def test_a_database_without_the_signal_is_told_what_to_look_for(tmp_path):
    (tmp_path / "own.dbc").write_text(
        'VERSION ""\nBU_: X\nBO_ 256 M: 8 X\n SG_ V : 0|16@1+ (0.1,0) [0|0] "km/h" X\n'
        ' SG_ T : 16|8@1+ (1,0) [0|0] "%" X\n SG_ N : 24|16@1+ (1,0) [0|0] "rpm" X\n'
    )
    config = from_dict(
        {
            "bus": {"dbc": [str(tmp_path / "own.dbc")]},
            "signals": {"speed": "M.V", "torque_fraction": "M.T", "engine_speed": "M.N"},
            "vehicle": {"reference_torque_Nm": 2500},
        }
    )
    assert all("SPN" in warning for warning in warnings_of(config, {}))


@pytest.mark.parametrize("nearer", ["engine_torque", "engine_power"])
def test_a_torque_or_power_at_the_crankshaft_lacks_nothing(nearer):
    assert unbound({"speed", "torque_fraction", nearer}) == {}
    assert unbound({"speed", "battery_voltage", "battery_current"}) == {}


@pytest.fixture(scope="module")
def drive():
    return frames_of(simulate(TRUCK, "mixed", 1500.0, np.random.default_rng(3)).signals)


@pytest.mark.slow
@pytest.mark.parametrize("role", [Role.FRICTION_FRACTION, Role.TORQUE_FRACTION_FINE])
def test_the_intervals_hold_without_a_part_of_the_torque(drive, role):
    pipeline = Pipeline(without(role))
    final: Estimate = [*pipeline.feed(drive), *pipeline.finish()][-1]
    truths = {"m": TRUCK.mass, "A": TRUCK.A, "C": TRUCK.C}
    for name, marginal in final.marginals.items():
        assert marginal is not None
        assert abs(marginal.mean - truths[name]) < 3 * marginal.sd, name
    assert final.A is not None
    assert final.A.sd > 40
