"""The demos on an arm of seven joints, which sinks when its drives are off and reaches each place in many postures."""

from pathlib import Path

import numpy as np

from benchmarks.arms import SEVEN
from procedures.demo.gap import programme_of
from procedures.demo.job import shut_down, start_again
from procedures.mock import SteppedBench, seeded_scenario
from procedures.survey import Model, Survey


def test_an_arm_that_sinks_is_held_from_one_runtime_to_the_next(tmp_path: Path) -> None:
    scenario = tmp_path / "scenario.toml"
    scenario.write_bytes(seeded_scenario("demo", None, was_homed=True))
    bench = SteppedBench(SEVEN, scenario, tmp_path)
    assert SEVEN.rest is not None
    try:
        client = bench.start(SEVEN)
        client.enable()
        client.home()
        client.move_joints(SEVEN.rest.q_rad)
        resting_m = bench.rig.tip_m()
        shut_down(SEVEN, bench, client)
        client = start_again(SEVEN, bench)
        assert client.status()["mode"] == "HOLDING"
        assert bench.rig.hand.state == "away"
        assert np.linalg.norm(np.subtract(bench.rig.tip_m(), resting_m)) < 0.005
        shut_down(SEVEN, bench, client)
    finally:
        bench.close()


def test_places_are_reached_near_the_posture_in_which_they_were_found_clear(tmp_path: Path) -> None:
    programme = programme_of(SEVEN)
    survey = Survey(Model(SEVEN), programme, tmp_path / "driven.csv")
    found = np.array([place.near_rad for place in programme.places])
    np.testing.assert_allclose(survey.q_rad, found, atol=1e-3)
