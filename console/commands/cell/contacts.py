"""`armwright session --cell`: two arms of a cell are led to planned contacts, and the joint angles of both are recorded."""

import argparse
import hashlib
from collections.abc import Mapping
from pathlib import Path

from calib.closed_chain.conduct import conduct, contact_plan
from calib.closed_chain.pair_problem import read_contacts
from calib.closed_chain.planning import pair_of
from calib.errors import SessionError
from calib.session.folder import PLAN, SessionFolder
from calib.session.plan import SessionPlan, fingerprint
from console.commands.connection import connected_arms
from control.model.cell import Cell, load_cell
from control.server.client import ArmClient
from hil_mocks.scenario import load_scenario
from procedures.folders import require_writable
from procedures.session.mock_session import SCENARIO, MockPairHand, Names, mock_pair, pair_station
from procedures.session.operator import (
    SPEED,
    ContactWords,
    Interface,
    last_s,
    ready,
    require_same,
    since_start_s,
)
from procedures.session.planning import OPTIONS

OF_BOTH = ("seat",)  # options that both kinds of session have


def session_of_contacts(given: argparse.Namespace) -> int:
    """Start or resume a session of contacts, and run it until the operator ends it or all are done."""
    for name in (*(option for option in OPTIONS if option not in OF_BOTH), "socket"):
        if getattr(given, name) is not None:
            raise SessionError(
                f"--{name} is for one arm at a board: with --cell, the contacts are in --contacts"
            )
    if given.has_arm:
        raise SessionError("--arm is for one arm at a board: the arms are those of --cell")
    cell = load_cell(given.cell)
    names = pair_of(cell, given.arms)
    identity, interface = _identity(cell, names), Interface.of(given)
    wanted = _wanted(given, cell, names, identity)
    require_writable(Path(given.out))
    if given.mock:
        if given.scenario is not None:
            load_scenario(given.scenario)
        with _folder(given, wanted, identity) as folder:
            _introduce(folder, interface)
            with mock_pair(cell, folder, given.scenario) as bench:
                hand = MockPairHand(cell, names, bench) if folder.plan.seat == "hand" else None
                station = pair_station(cell, names, bench.clients, 1.0, last_s(folder), hand)
                words = ContactWords(folder.plan, names)
                interface.conduct(folder, words, conduct(folder, station), hand is not None)
    else:
        if (Path(given.out) / SCENARIO).exists():
            raise SessionError(f"{given.out}: this session belongs to mock arms: add --mock")
        with connected_arms(given, names) as clients:
            _with_arms(given, cell, names, clients, wanted, identity, interface)
    return 0


def _with_arms(
    given: argparse.Namespace,
    cell: Cell,
    names: Names,
    clients: Mapping[str, ArmClient],
    wanted: SessionPlan | None,
    identity: str,
    interface: Interface,
) -> None:
    for client in clients.values():
        client.take_control()
    status = {name: ready(clients[name], name) for name in names}[names[0]]
    with _folder(given, wanted, identity) as folder:
        _introduce(folder, interface)
        station = pair_station(cell, names, clients, SPEED, since_start_s(folder, status))
        interface.conduct(folder, ContactWords(folder.plan, names), conduct(folder, station), may_auto=False)


def _folder(given: argparse.Namespace, wanted: SessionPlan | None, identity: str) -> SessionFolder:
    folder = SessionFolder(Path(given.out), wanted)
    try:
        require_same(folder, identity)
    except SessionError:
        folder.close()
        raise
    return folder


def _wanted(given: argparse.Namespace, cell: Cell, names: Names, identity: str) -> SessionPlan | None:
    """The plan of the options; None if none is given, which resumes the session."""
    if given.contacts is None:
        if (Path(given.out) / PLAN).exists() and given.seat is None:
            return None
        raise SessionError(
            "--contacts: expected a file of planned contacts (`armwright plan-contacts --out FILE`)"
        )
    arms = (cell.placed(names[0]).arm, cell.placed(names[1]).arm)
    planned, _ = read_contacts(Path(given.contacts), arms)
    plan = contact_plan(names, identity, planned, given.seat or "hand")
    plan.require_sound()
    return plan


def _identity(cell: Cell, names: Names) -> str:
    """Of both arms' parameters and their order."""
    return hashlib.sha256("".join(fingerprint(cell.placed(name).arm) for name in names).encode()).hexdigest()


def _introduce(folder: SessionFolder, interface: Interface) -> None:
    plan = folder.plan
    interface.introduce(folder, f"contacts of {plan.arm}, tips brought together by {plan.seat}")
