"""`armwright calibrate-pair`: two arms whose tips touch, from the joint angles of both."""

import argparse
import sys
from pathlib import Path

from calib.closed_chain.calibrate import PairPlan, calibrate_pair, choose_contacts, pair_text, write_pair
from calib.closed_chain.pair_problem import Contacts, names_of, read_contacts
from calib.errors import CalibrationError
from calib.identify.objective import objective_named
from calib.results import input_file, made_today
from console.commands.calibration.options import bounds_of, length_m, names_in
from console.commands.progress import Bar, answer, warn
from control.model.arm import Arm
from control.model.description import load_arm
from procedures.folders import require_new

NOISE_m = 2e-4  # of a contact, to compare what contacts say with what is known of the arms


def run(given: argparse.Namespace) -> int:
    """Read both arms and the contacts, then identify, or choose contacts."""
    arms = (load_arm(given.arms[0]), load_arm(given.arms[1]))
    contacts, warnings = read_contacts(Path(given.contacts), arms)
    warn(warnings)
    plan = _plan(given, arms)
    return (
        _choose(given, arms, contacts, plan)
        if given.choose is not None
        else _calibrate(given, arms, contacts, plan)
    )


def _plan(given: argparse.Namespace, arms: tuple[Arm, Arm]) -> PairPlan:
    tools = names_in(given.free_tool or [])
    for name in tools:
        if name not in names_of(arms):
            raise CalibrationError(f'--free-tool: expected some of {", ".join(names_of(arms))}, got "{name}"')
    bounds = bounds_of(given.bound or [])
    if bounds.own:
        raise CalibrationError(
            f"--bound: expected lengths=... or angles=... of both arms, got {next(iter(bounds.own))}"
        )
    return PairPlan(
        bounds=bounds,
        fixed=names_in(given.fix or []),
        free_tools=tools,
        objective=objective_named(given.objective),
    )


def _calibrate(given: argparse.Namespace, arms: tuple[Arm, Arm], contacts: Contacts, plan: PairPlan) -> int:
    out = Path(given.out)
    require_new(out, [*(f"{name}.toml" for name in names_of(arms)), "pair.json"])
    with Bar("calibrate-pair") as bar:
        found = calibrate_pair(arms, contacts, plan, bar.advance)
    nominal = [
        input_file(arm.path, "a nominal arm", f"{name}: {arm.path.name}")
        for name, arm in zip(names_of(arms), arms, strict=True)
        if arm.path is not None
    ]
    made = made_today(input_file(Path(given.contacts), "contacts"), *nominal)
    out.mkdir(parents=True, exist_ok=True)
    files = write_pair(out, arms, found, plan.objective.name, made)
    answer(given, files[-1], pair_text(arms, found) + "\n" + "".join(f"written: {file}\n" for file in files))
    return 0


def _choose(given: argparse.Namespace, arms: tuple[Arm, Arm], contacts: Contacts, plan: PairPlan) -> int:
    """Print the contacts that say most about both arms."""
    if given.choose < 1:
        raise CalibrationError(f"--choose: expected a number of contacts from 1 on, got {given.choose}")
    rows = choose_contacts(arms, contacts, plan, given.choose, length_m(given.noise, "--noise") or NOISE_m)
    sys.stdout.write("".join(f"{contacts.name[row]}\n" for row in rows))
    return 0
