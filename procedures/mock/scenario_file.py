"""The scenario of a mock arm as the text of a file, to be saved beside its measurements."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hil_mocks.scenario import Scenario


def seeded_scenario(name: str, seed: int | None, was_homed: bool) -> bytes:
    """The scenario with its seed as the text of a file, saved beside the results so that the run can be repeated.

    If the arm's file has no homing parameters, the boards start with their zeros set (`was_homed`).
    """
    import msgspec

    from hil_mocks.scenario import load_scenario

    scenario = load_scenario(name)
    if seed is not None:
        scenario = msgspec.structs.replace(scenario, seed=seed)
    if was_homed:
        scenario = msgspec.structs.replace(
            scenario, start=msgspec.structs.replace(scenario.start, homed=True)
        )
    return scenario_bytes(scenario)


def scenario_bytes(scenario: "Scenario") -> bytes:
    """A scenario as the text of a file."""
    import msgspec

    document = msgspec.to_builtins(scenario)
    del document["path"]
    return msgspec.toml.encode(_without_none(document))


def _without_none(value: object) -> object:
    if isinstance(value, dict):
        return {key: _without_none(item) for key, item in value.items() if item is not None}
    if isinstance(value, list | tuple):
        return [_without_none(item) for item in value]
    return value
